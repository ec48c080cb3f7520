"""Parts with images, colours and nothing are packed into one image without loss."""

import numpy as np
import pytest
from builders.mesh_files import (
    COLOURS,
    FACES,
    SIDES,
    UV,
    Gltf,
    check_box,
    encode,
    picture,
)
from PIL import Image

from ipjax.files.meshes.loading import load_mesh
from ipjax.files.meshes.textures import from_linear, sample_texture, to_linear

LIGHT = to_linear(COLOURS / 255)  # glTF keeps colours of vertices as linear light


def test_parts_of_every_kind_are_packed_without_loss(tmp_path):
    """A texture that repeats, a small one, a gradient of vertices, a flat colour, nothing: each keeps its colours."""
    gltf = Gltf()
    uv, gradient = UV.copy(), LIGHT.copy()
    uv[:4] += [3, -2]  # whole images away
    gradient[8:12] = to_linear(np.array([[120, 120, 120], [200, 100, 60], [100, 200, 150], [140, 160, 200]]) / 255)
    image = picture().resize((480, 320), Image.Resampling.NEAREST)
    large = gltf.skin(encode("PNG", image))
    small = gltf.skin()
    flat = gltf.material(baseColorFactor=[*to_linear(SIDES[3] / 255), 1])
    gltf.draw(FACES[:2], None, large, TEXCOORD_0=gltf.uv(uv))
    gltf.draw(FACES[2:4], None, small, TEXCOORD_0=gltf.uv())
    gltf.draw(FACES[4:6], COLOR_0=gltf.put(gradient.astype("<f4")))
    gltf.draw(FACES[6:8], None, flat)
    gltf.draw(FACES[8:10], COLOR_0=gltf.put(LIGHT.astype("<f4")))
    gltf.draw(FACES[10:])
    mesh = load_mesh(gltf.save(tmp_path / "box.glb"))
    wanted = SIDES.astype(float)
    wanted[2], wanted[5] = np.nan, 160
    check_box(mesh, wanted)
    # Over the two triangles of the third side colours blend as they do between vertices.
    side = np.flatnonzero(mesh.vertices[mesh.faces][:, :, 1].min(1) > 1.4)
    random = np.random.default_rng(0)
    corner = from_linear(gradient[8:12])[[[0, 1, 2], [0, 2, 3]]].astype(float)
    for face in side:
        weights = random.dirichlet(np.ones(3), 50)
        found = sample_texture(mesh.texture, weights @ mesh.uv[mesh.faces[face]])
        blends = [weights @ corner[i] for i in range(2)]
        assert min(np.abs(found - blend).max() for blend in blends) <= 2


@pytest.mark.parametrize("repeats", [3, 40, 500])
def test_an_image_that_repeats_stays_small_in_a_packed_texture(tmp_path, repeats):
    gltf = Gltf()
    uv = UV.copy()
    uv[:4] = (np.array([[0, 0], [1, 0], [1, 1], [0, 1]])) * repeats
    grain = np.zeros((64, 64, 3), np.uint8)
    grain[:, :, 0] = 200
    one, two = gltf.skin(encode("PNG", Image.fromarray(grain))), gltf.skin()
    gltf.draw(FACES[:2], None, one, TEXCOORD_0=gltf.uv(uv))
    gltf.draw(FACES[2:], None, two, TEXCOORD_0=gltf.uv(uv))
    mesh = load_mesh(gltf.save(tmp_path / "box.glb"))
    assert max(mesh.texture.shape) <= 4400
    wanted = SIDES.copy()
    wanted[0] = [200, 0, 0]
    check_box(mesh, wanted, atol=6)
