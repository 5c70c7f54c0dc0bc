"""glTF 2.0, as text and as GLB."""

from meshreg.io.format import Format

FORMAT = Format(
    keys=("glb", "gltf"),
    suffixes=(".glb", ".gltf"),
    read="meshreg.io.gltf.read:read",
    rewrite="meshreg.io.gltf.rewrite:rewrite",
    write="meshreg.io.gltf.write:write",
    written=(".glb",),
    magic=((b"glTF", "binary glTF", (".glb",)),),
    require_writable="meshreg.io.gltf.rewrite:require_writable",
    whole="glTF files are",
)
