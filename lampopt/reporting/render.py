"""Fixed views of a shape as pictures: parallel rays, soft light, a shadow on the ground, smooth edges."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from math import cos, radians, sin
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lampopt.errors import InputError
from lampopt.reading import why
from lampopt.reporting.shapes import FAR, SKY, Drawn, drawn, first_hits, sky_seen
from lampopt.types import Array
from lampopt.units import whole

if TYPE_CHECKING:
    from trimesh import Trimesh

STEEL = np.array([0.66, 0.71, 0.76])  # of a plain shape
BELOW, LEVEL, ABOVE = np.array([[33, 102, 172], [204, 204, 200], [178, 24, 43]]) / 255  # inside, on, outside the other
KEY, FILL = np.array([-0.42, 0.62, 0.66]), np.array([0.8, 0.05, 0.6])  # lights, in the camera's frame
SMOOTHING = 3  # rays along each side of a pixel at an edge
SHADOW = 0.45  # darkest
FACES = 30_000  # of a mesh that is drawn by itself
MARGIN = 1.08  # of a picture around the shape
GROUND = 32  # points along the ground where the shadow is worked out


@dataclass(frozen=True)
class View:
    """Where a shape is looked at from: `right`, `up` and `toward` the eye, as seen on the picture."""

    name: str
    right: tuple[float, float, float]
    up: tuple[float, float, float]
    axes: str
    shadow: bool = False

    @property
    def frame(self) -> Array:
        """(3, 3) rows right, up, toward the eye."""
        right, up = np.array(self.right), np.array(self.up)
        return np.stack([right, up, np.cross(right, up)])


def views(long: int) -> tuple[View, ...]:
    """Three-quarter, side, front and top view of shapes whose longer horizontal axis is `long`, 0 or 1; up is z."""
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    back, left = (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)
    turn, lift = radians(-58 if long == 0 else 32), radians(24)
    up = (-sin(lift) * cos(turn), -sin(lift) * sin(turn), cos(lift))
    three = View("three-quarter", (-sin(turn), cos(turn), 0.0), up, "", shadow=True)
    if long == 0:
        return (
            three,
            View("side", x, z, "x → · z ↑"),
            View("front", left, z, "y ← · z ↑"),
            View("top", x, y, "x → · y ↑"),
        )
    return three, View("side", y, z, "y → · z ↑"), View("front", x, z, "x → · z ↑"), View("top", y, back, "y → · x ↓")


def reach(shape: Drawn, view: View) -> Array:
    """(2,) width and height of `shape` in `view` [user's unit]."""
    seen = shape.vertices @ view.frame[:2].T
    return np.asarray(np.ptp(seen, axis=0) * shape.half)


def pictures(
    shape: Drawn, view: View, *, pixel: float, size: tuple[int, int], spread: float | None = None
) -> tuple[str, ...]:
    """`shape` in `view` as data URIs of WebP pictures with a clear ground: plain, then coloured by distance.

    Parameters
    ----------
    pixel
        Size of a pixel [user's unit].
    size
        Width and height [pixels].
    spread
        The colours go from -spread to spread [user's unit]; None: plain only.
    """
    from PIL import Image

    found = []
    for image in _images(shape, view, pixel / shape.half, size, spread):
        kept = io.BytesIO()
        Image.fromarray(image).save(kept, "WEBP", quality=82, method=4)
        found.append("data:image/webp;base64," + base64.b64encode(kept.getvalue()).decode())
    return tuple(found)


def saved(mesh: Trimesh, reference: Trimesh, path: Path, *, width: int) -> None:
    """Write three views of `mesh`, coloured by its distance to `reference` (PNG): red outside of it, blue inside.

    Raises
    ------
    InputError
        If it cannot be written, or `width` is no number of pixels.
    """
    from PIL import Image

    width = whole(width, "width", 64, 10_000)
    shape = drawn(mesh, faces=FACES, reference=reference)
    assert shape.distance is not None
    spread = float(np.abs(shape.distance).max()) or 1.0
    shown = views(int(shape.extents[1] > shape.extents[0]))[:3]
    boxes = [reach(shape, view) for view in shown]
    pixel = MARGIN * max(float(box[0]) for box in boxes) / width
    strips = []
    for view, box in zip(shown, boxes, strict=True):
        size = (width, max(round(MARGIN * float(box[1]) / pixel), 1))
        strips.append(Image.fromarray(_images(shape, view, pixel / shape.half, size, spread)[1]))
    sheet = Image.new("RGB", (width, sum(strip.height for strip in strips)), "white")
    top = 0
    for strip in strips:
        sheet.paste(strip, (0, top), strip)
        top += strip.height
    try:
        sheet.save(path, "PNG")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {why(error)}") from error


def colours(distance: Array, spread: float) -> Array:
    """(..., 3) colours, red outside and blue inside, of distances between -spread and spread."""
    t = np.clip(distance / spread, -1, 1)[..., None]
    return np.asarray(np.where(t < 0, LEVEL + (LEVEL - BELOW) * t, LEVEL + (ABOVE - LEVEL) * t))


def _images(shape: Drawn, view: View, pixel: float, size: tuple[int, int], spread: float | None) -> list[Array]:
    """(height, width, 4) bytes of each picture."""
    width, height = size
    frame = view.frame
    seen = np.asarray(shape.vertices @ frame.T)
    low, high = seen.min(0)[:2], seen.max(0)[:2]
    column, row = np.meshgrid(np.arange(width) + 0.5 - width / 2, height / 2 - np.arange(height) - 0.5)
    at = np.stack([column, row], -1) * pixel + (low + high) / 2  # (h, w, 2) on the picture's plane
    inside = ((at > low - pixel) & (at < high + pixel)).all(-1)
    face = np.full((height, width), -1)
    colours_, face[inside] = _shaded(shape, frame, seen, at[inside], spread)
    colour = np.zeros((*face.shape, *colours_.shape[1:]))
    colour[inside] = colours_
    edge = _edges(shape, face) & inside
    step = (np.arange(SMOOTHING) + 0.5) / SMOOTHING - 0.5
    around = np.stack(np.meshgrid(step, step), -1).reshape(-1, 2) * pixel
    many, _ = _shaded(shape, frame, seen, (at[edge][:, None] + around).reshape(-1, 2), spread)
    colour[edge] = many.reshape(-1, SMOOTHING**2, *many.shape[1:]).mean(1)
    dark = _shadow(shape, frame, at)[..., None] * (1 - colour[..., 3]) if view.shadow else np.zeros_like(colour[..., 3])
    opaque = colour[..., 3] + dark  # the shadow is black: only the shape has colour
    colour[..., :3] /= np.maximum(opaque, 1e-6)[..., None]
    colour[..., 3] = opaque
    return list((np.clip(colour, 0, 1) * 255).round().astype(np.uint8).transpose(2, 0, 1, 3))


def _shaded(shape: Drawn, frame: Array, seen: Array, at: Array, spread: float | None) -> tuple[Array, Array]:
    """Colours (M, pictures, 4), clear where nothing is met, and faces (M,) seen at points `at` (M, 2) of the plane."""
    origins = np.column_stack([at, np.full(len(at), FAR)])
    face, weight = first_hits(seen, shape.faces, origins, np.tile([0.0, 0.0, -1.0], (len(at), 1)))
    hit = np.flatnonzero(face >= 0)
    corner, weight = shape.faces[face[hit]], weight[hit]
    normal = np.einsum("mk,mkc->mc", weight, shape.normals[corner]) @ frame.T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    base = [np.tile(STEEL, (len(hit), 1))]
    if spread is not None and shape.distance is not None:
        base.append(colours((weight * shape.distance[corner]).sum(1), spread))
    found = np.zeros((len(at), len(base), 4))
    found[hit, :, :3] = _lit(np.stack(base, 1), normal, (weight * shape.sky[corner]).sum(1))
    found[hit, :, 3] = 1.0
    return found, face


def _lit(colour: Array, normal: Array, sky: Array) -> Array:
    """`colour` (M, pictures, 3) under soft light from above and two lamps beside the camera; page.js does the same."""
    key, fill = (v / np.linalg.norm(v) for v in (KEY, FILL))
    half = key + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    ambient = (0.40 + 0.14 * normal[:, 1]) * sky
    diffuse = 0.52 * np.clip(normal @ key, 0, None) * (0.45 + 0.55 * sky) + 0.16 * np.clip(normal @ fill, 0, None) * sky
    shine = 0.10 * np.clip(normal @ half, 0, None) ** 28 * sky
    light = ((ambient + diffuse) * 1.28)[:, None, None]
    return np.asarray(np.clip(colour**2.2 * light + shine[:, None, None], 0, 1) ** (1 / 2.2))


def _edges(shape: Drawn, face: Array) -> Array:
    """Where neighbouring pixels see surfaces that do not go smoothly into each other."""
    normal = np.zeros((*face.shape, 3))
    normal[face >= 0] = shape.normals[shape.faces[face[face >= 0]]].mean(1)
    rough = np.zeros(face.shape, bool)
    for axis in (0, 1):
        one = [slice(None), slice(None)]
        two = [slice(None), slice(None)]
        one[axis], two[axis] = slice(None, -1), slice(1, None)
        a, b = tuple(one), tuple(two)
        sharp = (normal[a] * normal[b]).sum(-1) < 0.9
        sharp &= (face[a] >= 0) | (face[b] >= 0)
        rough[a] |= sharp
        rough[b] |= sharp
    return rough


def _shadow(shape: Drawn, frame: Array, at: Array) -> Array:
    """How dark the ground is, (h, w), where each ray of the picture would meet it."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    low, high = shape.vertices.min(0), shape.vertices.max(0)
    floor = low[2] - 0.005
    wide = (high - low).max() * 0.3 + 0.05
    axes = [np.linspace(low[k] - wide, high[k] + wide, GROUND) for k in (0, 1)]
    points = np.stack([*np.meshgrid(*axes, indexing="ij"), np.full((GROUND, GROUND), floor)], -1).reshape(-1, 3)
    flat = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    seen = sky_seen(shape.vertices, shape.faces, points, flat, count=2 * SKY, steep=0.4)
    fade = np.minimum(1, 5 * (1 - np.abs(np.linspace(-1, 1, GROUND))))
    dark = gaussian_filter((1 - seen).reshape(GROUND, GROUND), 1.0) * np.outer(fade, fade)
    right, up, toward = frame
    x = at[..., :1] * right + at[..., 1:] * up  # (h, w, 3) on the picture's plane
    ground = x + toward * ((floor - x[..., 2:]) / toward[2])
    place = [(ground[..., k] - axes[k][0]) / (axes[k][1] - axes[k][0]) for k in (0, 1)]
    return np.asarray(SHADOW * np.clip(map_coordinates(dark, place, order=1, mode="constant"), 0, 1))
