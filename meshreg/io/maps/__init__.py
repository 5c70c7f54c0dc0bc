"""A DEM with its orthomosaic, as GeoTIFFs."""

from meshreg.io.format import Format

FORMAT = Format(
    keys=("maps",),
    suffixes=(".tif", ".tiff"),
    read="meshreg.io.maps.pair:read",
    rewrite="meshreg.io.maps.pair:rewrite",
    write="meshreg.io.maps.pair:write",
    written=(".tif", ".tiff"),
    magic=(
        (b"II*\0", "TIFF", (".tif", ".tiff")),
        (b"MM\0*", "TIFF", (".tif", ".tiff")),
        (b"II+\0", "TIFF", (".tif", ".tiff")),
        (b"MM\0+", "TIFF", (".tif", ".tiff")),
    ),
)
