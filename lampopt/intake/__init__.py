"""Intake: what every mesh is like, alone and against its fellows, before any fitting."""

from lampopt.intake.records import Finding, Health
from lampopt.intake.repair import repaired
from lampopt.intake.report import ALL, Facts, Intake, intake
from lampopt.intake.wrap import wrap

__all__ = ["ALL", "Facts", "Finding", "Health", "Intake", "intake", "repaired", "wrap"]
