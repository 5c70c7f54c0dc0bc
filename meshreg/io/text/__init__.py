"""Point clouds as columns of text."""

from meshreg.io.format import Format

FORMAT = Format(
    keys=("xyz",),
    suffixes=(".xyz", ".csv", ".txt", ".asc", ".pts"),
    read="meshreg.io.text.read:read",
    rewrite="meshreg.io.text.write:rewrite",
    write="meshreg.io.text.write:write",
    written=(".xyz", ".csv", ".txt"),
)
