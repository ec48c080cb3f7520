"""One mesh file, the files that it names, and the bytes of memory that it may take."""

import posixpath
import unicodedata
from pathlib import Path
from urllib.parse import unquote_to_bytes

from ipjax.files.meshes.textures import MAX_PIXELS_IN_ALL, Texture, TextureError, open_texture
from ipjax.files.storage.budget import budget

MAX_FACES = 3_000_000
MAX_BYTES = 2_000_000_000  # of a file
GROWTH = 24  # bytes that a large file may take in memory for each of its own, past the budget of any file
VERTEX_BYTES, FACE_BYTES = 240, 150  # of memory while a mesh is made
MAX_WARNINGS = 8  # of one file
IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tga", ".tif", ".tiff")
LFS_POINTER = b"version https://git-lfs"
BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # of UTF-8, which some editors write first


def check_faces(count: int) -> None:
    """Raises ValueError for more than MAX_FACES faces."""
    if count > MAX_FACES:
        raise ValueError(
            f"the mesh has {count:,} faces, more than {MAX_FACES:,}: simplify it first "
            "(quadric decimation to 200,000 faces loses nothing a camera sees)"
        )


class Source:
    """One mesh file: the files in its folder, the memory that it may still take, and notes on what was found."""

    def __init__(self, path: Path):
        self.path = path
        self.size = path.stat().st_size
        self.spent = 0
        self.pixels = 0
        self.warnings: list[str] = []
        self.notes: list[str] = []

    # Memory is counted before it is allocated.

    def take(self, count: int, what: str) -> None:
        """Count bytes that are about to be allocated. Raises ValueError where the file has used up its budget."""
        self.spent += int(count)
        limit = max(budget(), GROWTH * self.size)
        if self.spent > limit:
            raise ValueError(
                f"{what} would take {self.spent / 2**20:,.0f} MB of memory, more than the {limit / 2**20:,.0f} MB "
                "allowed for one file; simplify the mesh, or set IPJAX_FILE_BUDGET (MB) if you trust it"
            )

    def take_mesh(self, vertices: int, faces: int) -> None:
        """Count vertices and faces that are about to be made, instances one by one."""
        check_faces(faces)
        self.take(vertices * VERTEX_BYTES + faces * FACE_BYTES, f"{vertices:,} vertices and {faces:,} faces")

    def warn(self, sentence: str) -> None:
        """Note what is not read of the file: each sentence once, and at most MAX_WARNINGS of them."""
        if sentence in self.warnings or len(self.warnings) > MAX_WARNINGS:
            return
        more = "there is more that is not read"
        self.warnings.append(sentence if len(self.warnings) < MAX_WARNINGS else more)

    # Files in its folder.

    def read(self) -> bytes:
        """The file itself."""
        data = self.path.read_bytes()
        if data.startswith(LFS_POINTER):
            raise ValueError("is a Git LFS pointer, not the mesh: git lfs pull fetches it")
        return data

    def find(self, name: str | bytes, quoted: bool = False) -> Path | None:
        """The file of a name in the mesh file, which need not be in UTF-8 nor in the right case.

        None where there is none. Raises ValueError for a name that leads out of the mesh's folder.
        """
        raw = name if isinstance(name, bytes) else name.encode("utf-8", "surrogatepass")
        spellings = [unquote_to_bytes(raw), raw] if quoted else [raw]
        folder = self.path.parent.resolve()
        outside = None
        for spelling in spellings:
            for encoding in ("utf-8", "gb18030", "shift_jis", "cp1252", "latin-1"):
                try:
                    text = spelling.decode(encoding).strip().strip('"').replace("\\", "/")
                except UnicodeDecodeError:
                    continue
                if not text or "\0" in text or len(text) > 4096:
                    continue
                found = _find_in_folder(folder, text)
                if found is not None:
                    return found
                if not (folder / text).resolve().is_relative_to(folder):
                    outside = text
        if outside is not None:
            raise ValueError(f"names a file outside its own folder: {outside[:200]}")
        return None

    def read_companion(self, path: Path) -> bytes:
        """The bytes of a file that the mesh file names, counted against its budget."""
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise ValueError(f"names a file of {size / 1e9:.1f} GB: {path.name}")
        self.size += size
        self.take(size, f"the file {path.name}")
        return path.read_bytes()

    def open_texture(self, name: str | bytes, data: bytes | None = None, quoted: bool = False) -> Texture | None:
        """The texture of this name or in these bytes; None, and a warning, where it cannot be read."""
        shown = name if isinstance(name, str) else name.decode("utf-8", "replace")
        try:
            if data is None:
                path = self.find(name, quoted)
                if path is None:
                    raise TextureError(f"{shown[:200]} is named but missing")
                shown, data = path.name, self.read_companion(path)
            texture = open_texture(shown[:200], data)
        except TextureError as error:
            self.warn(f"{error}: shown without that texture")
            return None
        self.pixels += texture.width * texture.height
        if self.pixels > MAX_PIXELS_IN_ALL:
            raise ValueError(f"its textures have more than {MAX_PIXELS_IN_ALL:,} pixels together: make them smaller")
        return texture

    def guess_texture(self) -> Texture | None:
        """The image in the folder of a mesh that names none but has texture coordinates, if its name fits the mesh."""
        folder, stem = self.path.parent, self.path.stem.lower()
        try:
            files = sorted(path for path in folder.iterdir() if path.is_file())
        except OSError:
            return None
        meshes = {
            path.stem.lower() for path in files if path.suffix.lower() in (".obj", ".ply", ".glb", ".gltf", ".stl")
        }
        words = ("texture", "albedo", "diffuse", "basecolor", "base_color", "color", "kd", "tex")
        names = [stem, *(f"{stem}{join}{word}" for join in ("_", "-", "") for word in words), f"{stem}0", f"{stem}_0"]
        if meshes == {stem}:  # the only mesh here: a general name is enough
            names += [*words, "texture_kd", "texture_0", "material_0", "textured", "textured_mesh", "baked_texture"]
        images = {path.stem.lower(): path for path in reversed(files) if path.suffix.lower() in IMAGES}
        for name in names:
            if name in images:
                texture = self.open_texture(images[name].name, self.read_companion(images[name]))
                if texture is not None:
                    self.notes.append(f"{images[name].name} beside it is taken for its texture")
                    return texture
        return None


def _find_in_folder(folder: Path, name: str) -> Path | None:
    """A file in the folder or below, whatever the case and the Unicode form of its name; an absolute path of another
    machine is looked for by its last part."""
    for text in (posixpath.normpath(name), name.rsplit("/", 1)[-1]):
        here, parts = folder, [part for part in text.split("/") if part not in ("", ".")]
        if ":" in text or text.startswith("/") or ".." in parts or not parts:
            continue
        for part in parts:
            try:
                if (here / part).exists():
                    here = here / part
                    continue
                wanted = unicodedata.normalize("NFC", part).casefold()
                same = [x for x in here.iterdir() if unicodedata.normalize("NFC", x.name).casefold() == wanted]
            except OSError:
                break
            if not same:
                break
            here = min(same)
        else:
            if here.is_file() and here.resolve().is_relative_to(folder):
                return here
    return None
