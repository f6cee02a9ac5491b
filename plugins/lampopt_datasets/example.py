"""Small folders of boxes and tables, laid out as a dataset is: what sources show of themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path


def temporary(
    name: str,
    boxes: Mapping[str, Sequence[float]] | None = None,
    texts: Mapping[str, Sequence[str]] | None = None,
) -> Path:
    """A folder that is removed when Python ends, with mesh files and text files in it.

    Parameters
    ----------
    name
        Of the source; it is part of the folder's name.
    boxes
        By path in the folder: lengths along x, y, z of the box in this mesh file.
    texts
        By path in the folder: the lines of this file.
    """
    import atexit
    from shutil import rmtree
    from tempfile import mkdtemp

    from trimesh.creation import box

    folder = Path(mkdtemp(prefix=f"lampopt-{name}-"))
    atexit.register(rmtree, folder, ignore_errors=True)
    for file in (*(boxes or ()), *(texts or ())):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
    for file, sides in (boxes or {}).items():
        box(sides).export(folder / file)
    for file, lines in (texts or {}).items():
        (folder / file).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder
