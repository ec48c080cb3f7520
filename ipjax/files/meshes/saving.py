"""Writing mesh files."""

from pathlib import Path

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
