"""Writing mesh files."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from ipjax.files.meshes.formats.gltf_writing import make_glb
from ipjax.files.meshes.mesh import Mesh
from ipjax.files.storage.writing import write_bytes, write_text


def save_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write the mesh in its present frame: .ply and .stl without texture (colours per vertex), .glb and .obj with it.

    Raises ValueError for another extension. Positions are float32 in .glb and .ply.
    """
    import trimesh
    from PIL import Image
    from trimesh.exchange.obj import export_obj
    from trimesh.visual import ColorVisuals, TextureVisuals
    from trimesh.visual.material import SimpleMaterial

    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".ply", ".glb", ".obj", ".stl"):
        raise ValueError(f"{path.name}: meshes are written as .ply, .glb, .obj or .stl")
    out = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False)
    if mesh.texture is not None and mesh.uv is not None and kind == ".obj":
        material = SimpleMaterial(name=path.stem, image=Image.fromarray(mesh.texture), diffuse=[255, 255, 255, 255])
        out.visual = TextureVisuals(uv=mesh.uv, material=material)
    else:
        out.visual = ColorVisuals(out, vertex_colors=mesh.colours)
    if kind == ".obj":
        text, files = export_obj(out, include_normals=True, return_texture=True, mtl_name=path.stem + ".mtl")
        for name, data in files.items():
            write_bytes(path.parent / name, data)
        write_text(path, text)
        return
    if kind == ".glb":
        write_bytes(path, make_glb(mesh.vertices, mesh.faces, mesh.normals, mesh.colours, mesh.uv, mesh.texture))
        return
    data = out.export(file_type=kind[1:])
    write_bytes(path, data if isinstance(data, bytes) else str(data).encode())


def save_points(
    path: str | Path,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"],
) -> None:
    """Write a cloud of points with normals and colours as binary PLY; positions are float32.

    Raises:
      ValueError: the name does not end in .ply.
      OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise ValueError(f"{path.name}: clouds of points are written as .ply")
    kinds = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [
        (c, "u1") for c in ("red", "green", "blue")
    ]
    rows = np.zeros(len(points), kinds)
    for k in range(3):
        rows["xyz"[k]], rows["n" + "xyz"[k]], rows[("red", "green", "blue")[k]] = (
            points[:, k],
            normals[:, k],
            colours[:, k],
        )
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [f"property {'uchar' if kind == 'u1' else 'float'} {name}" for name, kind in kinds]
    write_bytes(path, ("\n".join([*head, "end_header"]) + "\n").encode() + rows.tobytes())
