"""Cameras from files: every spelling of one camera is that camera; what is not understood is refused, not dropped."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipjax.files.cameras.intrinsics import Intrinsics, check_depth_scale, list_misfits
from ipjax.files.cameras.reading import as_intrinsics, read_camera

WIDTH, HEIGHT = 640, 480
FX, FY, CX, CY = 605.5, 604.25, 322.75, 238.5
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
FLAT = K.reshape(-1).tolist()
D = [0.11, -0.2, 0.001, -0.002, 0.03]
FISH = [0.02, -0.01, 0.003, -0.001]
FOUR = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}
NAMES = dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))

ROS1 = f"""
image_width: {WIDTH}
image_height: {HEIGHT}
camera_name: head   # a comment
camera_matrix:
  rows: 3
  cols: 3
  data: [{FX}, 0.0, {CX},
         0.0, {FY}, {CY}, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {D}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]}}
"""
ROS2 = (
    f"header:\n  frame_id: camera\nheight: {HEIGHT}\nwidth: {WIDTH}\ndistortion_model: plumb_bob\nd:\n"
    + "".join(f"- {x}\n" for x in D)
    + "k:\n"
    + "".join(f"- {x}\n" for x in FLAT)
    + "r: [1, 0, 0]\nbinning_x: 0\nbinning_y: 1\nroi: {x_offset: 0, y_offset: 0, height: 0, width: 0}\n---\n"
)
OPENCV = f"""%YAML:1.0
---
image_width: {WIDTH}
image_height: {HEIGHT}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {", ".join(map(str, FLAT))} ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ {", ".join(map(str, D))} ]
"""
SIZE = {"width": WIDTH, "height": HEIGHT}
SAME = {  # the same camera with the same lens
    "ros1.yaml": ROS1,
    "ros2.yaml": ROS2,
    "opencv.yaml": OPENCV,
    "info.json": dict(K=FLAT, D=D, distortion_model="plumb_bob", **SIZE),
    "matrix and dist.json": dict(camera_matrix=K.tolist(), dist=[D], image_size=[WIDTH, HEIGHT]),
    "distCoeffs.json": dict(cameraMatrix=K.tolist(), distCoeffs=[[x] for x in D], resolution=[WIDTH, HEIGHT]),
    "bop.json": {"7": dict(cam_K=FLAT, disto=D, depth_scale=1.0, w=WIDTH, h=HEIGHT)},
    "k1.json": dict(**FOUR, **NAMES, w=WIDTH, h=HEIGHT),
    "nerf.json": dict(fl_x=FX, fl_y=FY, cx=CX, cy=CY, camera_model="OPENCV", **NAMES, w=WIDTH, h=HEIGHT, frames=[]),
    "four and distortion_coefficients.json": dict(**FOUR, distortion_coefficients=D, resolution=f"{WIDTH}x{HEIGHT}"),
    "four and coefficients by name.json": dict(**FOUR, distortion=NAMES, image_shape=[HEIGHT, WIDTH, 3]),
    "realsense.json": dict(
        color=dict(**SIZE, ppx=CX, ppy=CY, fx=FX, fy=FY, model="distortion.brown_conrady", coeffs=D),
        depth=dict(**SIZE, ppx=1, ppy=2, fx=3, fy=4, model="distortion.brown_conrady", coeffs=[0] * 5),
    ),
    "kalibr.yaml": f"cam0:\n  camera_model: pinhole\n  distortion_coeffs: {D}\n  distortion_model: radtan\n"
    f"  intrinsics: [{FX}, {FY}, {CX}, {CY}]\n  resolution: [{WIDTH}, {HEIGHT}]\n",
    "orb.yaml": '%YAML:1.0\nCamera.type: "PinHole"\n'
    + "".join(f"Camera.{name}: {value}\n" for name, value in (FOUR | NAMES | SIZE).items())
    + "Camera.fps: 30.0\n",
    "vins.yaml": "%YAML:1.0\n---\nmodel_type: PINHOLE\ncamera_name: camera\n"
    f"image_width: {WIDTH}\nimage_height: {HEIGHT}\nprojection_parameters: {json.dumps(FOUR)}\n"
    f"distortion_parameters: {json.dumps(NAMES)}\n",
    "quoted.json": {name: str(value) for name, value in (FOUR | NAMES | SIZE).items()},
    "flow.yaml": f"{{fx: {FX}, fy: {FY}, cx: {CX}, cy: {CY}, dist_coeffs: {D}, img_size: [{WIDTH}, {HEIGHT}]}}",
    "nested.json": dict(intrinsics=FOUR, distortion=dict(model="brown_conrady", coefficients=D), image=SIZE),
    "zeros behind.json": dict(K=FLAT, D=[*D, 0, 0, 0], distortion_model="plumb_bob", **SIZE),
    "kc.json": dict(**FOUR, kc=D, **SIZE),
    "rows of four.json": dict(intrinsic=[*([*row, 0.0] for row in K.tolist()), [0, 0, 0, 1]], D=D, **SIZE),
    "one K in three forms.json": dict(
        K=FLAT, cam_K=K.tolist(), camera_matrix=dict(rows=3, cols=3, data=FLAT), D=D, **SIZE
    ),
    "upper.yaml": f"K: {FLAT}\nDistortion_Model: Plumb_Bob\nD: {D}\nWidth: {WIDTH}\nHeight: {HEIGHT}\n",
}


@pytest.mark.parametrize("name", SAME)
def test_every_spelling_is_the_same_camera(tmp_path, name):
    text = SAME[name]
    (tmp_path / name).write_text(text if isinstance(text, str) else json.dumps(text))
    camera = read_camera(tmp_path / name)
    np.testing.assert_allclose(camera.matrix, K)
    assert camera.distortion == tuple(D) and camera.lens in ("opencv", "plumb_bob")
    assert camera.size == (WIDTH, HEIGHT)


@pytest.mark.parametrize("count", [3, 4])
def test_numbers_in_rows_of_four_are_a_camera_where_they_move_nothing(tmp_path, count):
    rows = np.eye(4)[:count]
    rows[:3, :3] = K
    np.savetxt(tmp_path / "k.txt", rows)
    np.testing.assert_allclose(read_camera(tmp_path / "k.txt").matrix, K)
    rows[0, 3] = -40.0  # the right camera of two
    np.savetxt(tmp_path / "k.txt", rows)
    with pytest.raises(ValueError, match="numbers are no camera"):
        read_camera(tmp_path / "k.txt")


FISHES = [
    dict(K=FLAT, D=FISH, distortion_model="equidistant"),
    dict(K=FLAT, D=FISH, distortion_model="fisheye"),
    dict(K=FLAT, D=[*FISH, 0.0], distortion_model="Kannala_Brandt4"),
    dict(**FOUR, coeffs=[*FISH, 0], model="distortion.kannala_brandt4"),
    dict(fl_x=FX, fl_y=FY, cx=CX, cy=CY, camera_model="OPENCV_FISHEYE", **{f"k{i + 1}": FISH[i] for i in range(4)}),
    {"Camera.type": "KannalaBrandt8"}
    | {f"Camera.{name}": value for name, value in FOUR.items()}
    | {f"Camera.k{i + 1}": FISH[i] for i in range(4)},
    {
        "cam0": dict(
            camera_model="pinhole", distortion_model="equidistant", distortion_coeffs=FISH, intrinsics=[FX, FY, CX, CY]
        )
    },
]


@pytest.mark.parametrize("entry", FISHES)
def test_a_fisheye_is_one_whatever_it_is_called(entry):
    camera = read_camera(entry)
    assert camera.lens == "equidistant" and camera.distortion == tuple(FISH)
    np.testing.assert_allclose(camera.matrix, K)


def test_a_fisheye_with_zeros_is_no_pinhole():
    camera = Intrinsics(K, (0.0,) * 4, "equidistant")
    assert camera.distortion == (0.0,) * 4
    # An empty list of coefficients says nothing about the lens.
    with pytest.raises(ValueError, match="needs four coefficients"):
        read_camera(dict(K=FLAT, D=[], distortion_model="equidistant"))


NONZERO = [0.02] * 5
REFUSED = {
    "inverse": (dict(K=FLAT, D=NONZERO, distortion_model="inverse_brown_conrady"), "unknown lens"),
    "modified": (dict(**FOUR, coeffs=NONZERO, model="distortion.modified_brown_conrady"), "unknown lens"),
    "fov": (dict(K=FLAT, D=[0.02], distortion_model="FOV"), "unknown lens"),
    "omni": (dict(intrinsics=[1.2, FX, FY, CX, CY], camera_model="omni", distortion_coeffs=[0] * 4), "5 entries"),
    "double sphere": (dict(**FOUR, camera_model="ds", xi=-0.2, alpha=0.5), "xi"),
    "fisheye624": (dict(cam_K=FLAT, cam_model="CameraModelType.FISHEYE624"), "unknown lens"),
    "model in a dictionary": (dict(cam_K=FLAT, cam_model=dict(projection_model_type="FISHEYE624")), "unknown lens"),
    "cam_model": (dict(cam_K=FLAT, cam_model="FISHEYE"), "needs four coefficients"),
    "none with coefficients": (dict(K=FLAT, D=NONZERO, distortion_model="none"), "says no distortion"),
    "equidistant of five": (dict(K=FLAT, D=NONZERO, distortion_model="equidistant"), "do not fit"),
    "plumb bob of eight": (dict(K=FLAT, D=[0.02] * 8, distortion_model="plumb_bob"), "do not fit"),
    "two models": (dict(K=FLAT, D=FISH, distortion_model="equidistant", lens_model="brown_conrady"), "exclude"),
    "twice": (dict(K=FLAT, D=D, k1=0.3), "given twice"),
    "k4 alone": (dict(**FOUR, k1=0.1, k2=0.1, k3=0.1, k4=0.1), "may be a fisheye"),
    "unheard-of list": (dict(**FOUR, lens_distortion_lut=[1.0, 2.0]), "lens_distortion_lut looks like"),
    "radial": (dict(cam_K=FLAT, radial=[0.1, 0.2]), "radial looks like"),
    "tangential": (dict(cam_K=FLAT, tangential_distortion=dict(a=0.0, b=1e-3)), "tangential_distortion looks like"),
    "codx": (dict(**FOUR, k1=0.1, codx=2.0), "codx looks like"),
    "skew": (dict(**FOUR, skew=5.0), "skew"),
    "skew in K": (dict(cam_K=[FX, 5, CX, 0, FY, CY, 0, 0, 1]), "skew"),
    "transposed": (dict(cam_K=K.T.reshape(-1).tolist()), "row by row"),
    "negative": (dict(cam_K=[FX, 0, CX, 0, -FY, CY, 0, 0, 1]), "mirrored"),
    "no centre": (dict(cam_K=[FX, 0, 0, 0, FY, 0, 0, 0, 1]), "cx and cy are missing"),
    "shares": (dict(cam_K=[FX / 640, 0, 0.5, 0, FY / 480, 0.5, 0, 0, 1]), "shares of the image"),
    "huge": (dict(cam_K=[10**400, 0, CX, 0, FY, CY, 0, 0, 1]), "must be numbers"),
    "two sizes": (dict(**FOUR, width=640, height=480, resolution=[1280, 960]), "two image sizes"),
    "two cameras": (dict(left=dict(K=FLAT), right=dict(K=FLAT)), "several cameras"),
    "two matrices": (dict(cam_K=FLAT, **FOUR | {"fx": 300.0}), "different things"),
    "no cy": (dict(fx=FX, fy=FY, cx=CX), "has no cy"),
    "offset": (dict(K=FLAT, D=[], roi=dict(x_offset=8, y_offset=0, width=0, height=0)), "no size"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_understood_is_refused_in_one_sentence(tmp_path, name):
    entry, words = REFUSED[name]
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(entry))
    with pytest.raises(ValueError, match=words) as caught:
        read_camera(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@given(
    st.sampled_from(["k1", "p2", "disto", "distortion_params", "lens_coeffs", "radial_dist", "tau_x", "Dist_Coef"]),
    st.floats(1e-6, 1.0),
)
def test_no_lens_is_dropped(name, value):
    """Whatever is called like a lens is applied or refused; only zeros may be left out."""
    for entry in (dict(cam_K=FLAT), dict(**FOUR), dict(camera_matrix=K.tolist())):
        try:
            camera = read_camera(entry | {name: value if name in ("k1", "p2", "tau_x") else [value, value, 0.0, 0.0]})
        except ValueError:
            continue
        assert np.isclose(camera.distortion, value, rtol=1e-9).any()
        for nothing in (0, [0.0] * 5, None, []):
            assert read_camera(entry | {name: nothing}).distortion == ()


@pytest.mark.parametrize(
    "names",
    [
        {"width": 640, "height": 480}, {"w": 640, "h": 480}, {"image_width": "640", "image_height": "480"},
        {"imageWidth": 640, "imageHeight": 480}, {"img_w": 640, "img_h": 480}, {"resolution": [640, 480]},
        {"image_size": [640, 480]}, {"image_size": [480, 640]}, {"image_size": {"width": 640, "height": 480}},
        {"size": "640 x 480"},
        {"cols": 640, "rows": 480}, {"shape": [480, 640]}, {"frame_width": 640, "frame_height": 480},
        {"resolution_x": 640, "resolution_y": 480}, {"width_px": 640, "height_px": 480},
    ],
)  # fmt: skip
def test_sizes_in_any_spelling(names):
    assert read_camera(dict(cam_K=FLAT) | names).size == (640, 480)
    assert read_camera(dict(**FOUR) | {key: 0 for key in names}).size is None  # drivers that do not know


def test_the_sensor_s_camera_becomes_the_image_s():
    """Region of interest and binning: pixels keep looking where they looked."""
    ray = np.array([0.1, -0.05, 1.0])
    whole = (K @ ray)[:2]
    base = dict(K=FLAT, D=D, distortion_model="plumb_bob", width=WIDTH, height=HEIGHT)
    roi = read_camera(base | {"roi": dict(x_offset=100, y_offset=50, width=400, height=300)})
    assert roi.size == (400, 300) and roi.distortion == tuple(D)
    np.testing.assert_allclose((roi.matrix @ ray)[:2], whole - (100, 50))
    binned = read_camera(base | {"binning_x": 2, "binning_y": 2})
    assert binned.size == (320, 240)
    # Pixel i of the small image covers pixels 2 i and 2 i + 1.
    np.testing.assert_allclose((binned.matrix @ ray)[:2], (whole - 0.5) / 2)
    both = read_camera(
        base | {"binning_x": 2, "binning_y": 4, "roi": dict(x_offset=100, y_offset=48, width=400, height=304)}
    )
    assert both.size == (200, 76)
    np.testing.assert_allclose((both.matrix @ ray)[:2], (whole - (100, 48) - (0.5, 1.5)) / (2, 4))


@given(
    st.floats(0.2, 5.0).filter(lambda r: abs(r - 1) > 0.22),
    st.floats(-0.02, 0.02),
    st.floats(-0.02, 0.02),
    st.sampled_from([(640, 480), (1280, 720), (1920, 1080), (4032, 3024)]),
)
def test_a_matrix_of_another_resolution_is_told(ratio, dx, dy, size):
    width, height = size
    focal = 0.9 * width
    right = np.array([[focal, 0, (0.5 + dx) * width - 0.5], [0, focal, (0.5 + dy) * height - 0.5], [0, 0, 1]])
    assert list_misfits(Intrinsics(right), width, height) == []
    wrong = right.copy()
    wrong[:2] *= ratio
    wrong[:2, 2] += 0.5 * ratio - 0.5
    said = " ".join(list_misfits(Intrinsics(wrong), width, height))
    assert "principal point" in said and "multiply" in said
    factor = float(said.split("multiply fx, fy, cx and cy by ")[1].split()[0].rstrip(".,:"))
    assert factor * ratio == pytest.approx(1, abs=0.06)


def test_other_misfits_are_told():
    told = lambda fx, fy, cx, cy: " ".join(list_misfits(as_intrinsics((fx, fy, cx, cy)), 640, 480))
    assert told(600, 600, 320, 240) == ""
    assert "look exchanged" in told(600, 600, 240, 320)
    assert "far from the middle" in told(600, 600, 3000, 2000)
    assert "field of view" in told(4000, 4000, 320, 240)
    assert "field of view" in told(150, 150, 320, 240)
    assert "stretched" in told(600, 450, 320, 240)


@pytest.mark.parametrize(
    ("scale", "said"),
    [("mm", "0.001 for mm"), ("Metres", "1 for Metres"), ("inch", "0.001 for millimetres"), (0, "not 0"), ([1], "not"),
     (float("nan"), "not nan")],
)  # fmt: skip
def test_a_unit_by_its_name_is_refused_with_its_number(scale, said):
    with pytest.raises(ValueError, match=f"metres per depth unit.*{said}"):
        check_depth_scale(scale)
    assert check_depth_scale(np.float32(0.5)) == 0.5
