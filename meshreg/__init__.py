"""Register repeat surveys of the seafloor: read, rasterize, estimate, judge, apply, write.

The public names below are imported at first use, in the order in which data flows.
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "read_survey": "meshreg.io",
    "rasterize": "meshreg.raster",
    "estimate_offset": "meshreg.offsets",
    "estimate_offsets": "meshreg.offsets",
    "register_pair": "meshreg.pipeline",
    "self_test": "meshreg.pipeline",
    "apply_transform": "meshreg.apply",
    "write_survey": "meshreg.io",
    "write_registration": "meshreg.io",
    "read_registration": "meshreg.io",
    "Settings": "meshreg.settings",
    "Survey": "meshreg.records",
    "Mesh": "meshreg.records",
    "PointCloud": "meshreg.records",
    "Maps": "meshreg.records",
    "Grid": "meshreg.records",
    "SurveyRaster": "meshreg.records",
    "Transform": "meshreg.records",
    "Warp": "meshreg.records",
    "OffsetEstimate": "meshreg.records",
    "Registration": "meshreg.records",
    "MeshregError": "meshreg.errors",
}
__all__ = ["__version__", *_HOMES]  # noqa: PLE0604

logging.getLogger("meshreg").addHandler(logging.NullHandler())

if TYPE_CHECKING:
    from meshreg.apply import apply_transform as apply_transform
    from meshreg.errors import MeshregError as MeshregError
    from meshreg.io import read_registration as read_registration
    from meshreg.io import read_survey as read_survey
    from meshreg.io import write_registration as write_registration
    from meshreg.io import write_survey as write_survey
    from meshreg.offsets import estimate_offset as estimate_offset
    from meshreg.offsets import estimate_offsets as estimate_offsets
    from meshreg.pipeline import register_pair as register_pair
    from meshreg.pipeline import self_test as self_test
    from meshreg.raster import rasterize as rasterize
    from meshreg.records import Grid as Grid
    from meshreg.records import Maps as Maps
    from meshreg.records import Mesh as Mesh
    from meshreg.records import OffsetEstimate as OffsetEstimate
    from meshreg.records import PointCloud as PointCloud
    from meshreg.records import Registration as Registration
    from meshreg.records import Survey as Survey
    from meshreg.records import SurveyRaster as SurveyRaster
    from meshreg.records import Transform as Transform
    from meshreg.records import Warp as Warp
    from meshreg.settings import Settings as Settings


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'meshreg' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
