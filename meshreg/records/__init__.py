"""The records that flow through meshreg. Metres and radians; x east, y north, z up.

Rasters are (row, col) with row 0 in the north. Arrays in a record are read-only. "Absolute"
coordinates are those after a file's axes, unit and shift have been applied; geometry is kept as
float64 relative to a survey's `origin`, because float32 at UTM size steps by half a metre.
"""

from meshreg.records.arrays import (
    Bool,
    Float32,
    Float64,
    Int32,
    UInt8,
    ends,
)
from meshreg.records.estimate import (
    OffsetAt,
    OffsetEstimate,
    Status,
)
from meshreg.records.finding import (
    Finding,
    Gain,
    Layer,
    Severity,
    Tear,
)
from meshreg.records.grid import (
    RASTER_OF,
    Channel,
    Grid,
    SurveyRaster,
)
from meshreg.records.registration import (
    Registration,
    Verdict,
)
from meshreg.records.survey import (
    Frame,
    Maps,
    Mesh,
    PointCloud,
    SourceFile,
    Survey,
    Texture,
)
from meshreg.records.transform import (
    Transform,
)
from meshreg.records.warp import (
    Warp,
    cubic_weights,
)

__all__ = [
    "RASTER_OF",
    "Bool",
    "Channel",
    "Finding",
    "Float32",
    "Float64",
    "Frame",
    "Gain",
    "Grid",
    "Int32",
    "Layer",
    "Maps",
    "Mesh",
    "OffsetAt",
    "OffsetEstimate",
    "PointCloud",
    "Registration",
    "Severity",
    "SourceFile",
    "Status",
    "Survey",
    "SurveyRaster",
    "Tear",
    "Texture",
    "Transform",
    "UInt8",
    "Verdict",
    "Warp",
    "cubic_weights",
    "ends",
]
