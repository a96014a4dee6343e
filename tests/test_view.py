"""The internal view against closed forms: where pixels go, and where a known flow comes back."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from worlds import EUROC, textured_image

from viflow_anomaly.config import ViewConfig
from viflow_anomaly.errors import InvalidInputError, TooLargeError
from viflow_anomaly.geometry import pixel_grid, project_rays, unproject_pixels
from viflow_anomaly.sensor_data import DistortionModel, PinholeCamera
from viflow_anomaly.view import SIDE_MULTIPLE_PX, InternalView, make_view

# Steps of 1, 2 and 3 for the sizes below, whatever the defaults are.
WHOLE = ViewConfig(focal_px=232.0, max_width=416, max_height=416, max_pinhole_width=640, max_pinhole_height=512)
CROP = ViewConfig(mode="center_crop")
STRIDES = (1, 4)
TOLERANCE_PX = 0.05

SCALED = PinholeCamera(fx=348.0, fy=290.0, cx=150.25, cy=130.5, width=320, height=240)
FISHEYE = PinholeCamera(
    fx=190.0,
    fy=190.0,
    cx=255.0,
    cy=250.0,
    width=512,
    height=512,
    distortion_model="equidistant",
    distortion_coeffs=(0.0034, 0.0007, -0.0021, 0.0002),
)

CASES = [
    pytest.param(WHOLE, 320, 224, None, id="whole, not resampled"),
    pytest.param(WHOLE, 832, 448, None, id="shrunk by 2"),
    pytest.param(WHOLE, 1248, 480, None, id="shrunk by 3"),
    pytest.param(WHOLE, 1241, 376, None, id="shrunk by a fraction"),
    pytest.param(CROP, 300, 259, None, id="crop"),
    pytest.param(WHOLE, 320, 240, SCALED, id="pinhole, scaled and off-centre"),
    pytest.param(WHOLE, 752, 480, EUROC, id="EuRoC, distorted"),
    pytest.param(WHOLE, 512, 512, FISHEYE, id="fisheye"),
]


def flow_cells(view: InternalView, stride: int) -> NDArray[np.float32]:
    """[h, w, 2] view pixel in the middle of every flow cell."""
    rows, columns = -(-view.height // stride), -(-view.width // stride)
    return (pixel_grid(rows, columns) + np.float32(0.5)) * np.float32(stride) - np.float32(0.5)


def constant_flow(view: InternalView, stride: int, flow_px: tuple[float, float]) -> NDArray[np.float32]:
    return np.full_like(flow_cells(view, stride), 0) + np.array(flow_px, dtype=np.float32)


def view_pixels(view: InternalView, camera: PinholeCamera | None) -> NDArray[np.float64]:
    """[H, W, 2] view pixel of every source pixel, in closed form."""
    source = pixel_grid(view.source_height, view.source_width).astype(np.float64)
    if camera is not None:
        return unproject_pixels(camera, source) * WHOLE.focal_px + view.middle_px
    return (source - view.center_px) / view.step_px + view.middle_px


def source_pixels(view: InternalView, camera: PinholeCamera | None, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Back from view pixels, in closed form."""
    if camera is not None:
        return np.asarray(project_rays(camera, (at - view.middle_px) / WHOLE.focal_px), dtype=np.float64)
    return (at - view.middle_px) * view.step_px + view.center_px


def shown(view: InternalView) -> NDArray[np.bool_]:
    mask = view.analyzed()
    return np.ones((view.source_height, view.source_width), dtype=np.bool_) if mask is None else mask


@pytest.mark.parametrize("stride", STRIDES)
@pytest.mark.parametrize(("config", "width", "height", "camera"), CASES)
def test_no_flow_leaves_every_pixel_where_it_is(
    config: ViewConfig, width: int, height: int, camera: PinholeCamera | None, stride: int
) -> None:
    view = make_view(config, width=width, height=height, camera=camera)
    target = view.target_coordinates(constant_flow(view, stride, (0, 0)), stride)
    assert target.shape == (height, width, 2)
    assert target.dtype == np.float32
    np.testing.assert_allclose(target, pixel_grid(height, width), atol=TOLERANCE_PX)


@pytest.mark.parametrize("stride", STRIDES)
@pytest.mark.parametrize(("config", "width", "height", "camera"), CASES)
def test_a_constant_flow_comes_back_in_source_pixels(
    config: ViewConfig, width: int, height: int, camera: PinholeCamera | None, stride: int
) -> None:
    view = make_view(config, width=width, height=height, camera=camera)
    target = view.target_coordinates(constant_flow(view, stride, (5.0, -3.0)), stride)
    expected = source_pixels(view, camera, view_pixels(view, camera) + np.array([5.0, -3.0]))
    inner = interior(view, camera, stride)
    assert np.abs(target - expected)[inner].max() < TOLERANCE_PX * max(1.0, *view.step_px)


@pytest.mark.parametrize(("config", "width", "height", "camera"), CASES)
def test_a_linear_flow_lands_on_the_right_pixels(
    config: ViewConfig, width: int, height: int, camera: PinholeCamera | None
) -> None:
    view = make_view(config, width=width, height=height, camera=camera)
    zoom = np.array([[0.02, -0.01], [0.015, 0.03]])
    flow = (flow_cells(view, 4) - view.middle_px) @ zoom.T + (1.0, 2.0)
    target = view.target_coordinates(flow.astype(np.float32), 4)
    at = view_pixels(view, camera)
    expected = source_pixels(view, camera, at + (at - view.middle_px) @ zoom.T + (1.0, 2.0))
    inner = interior(view, camera, 4)
    assert np.abs(target - expected)[inner].max() < TOLERANCE_PX * max(1.0, *view.step_px)


def interior(view: InternalView, camera: PinholeCamera | None, stride: int) -> NDArray[np.bool_]:
    """Source pixels between the middles of the outermost flow cells (beyond them the flow is held)."""
    at, margin = view_pixels(view, camera), (stride - 1) / 2
    inner = (at >= margin) & (at <= (view.width - 1 - margin, view.height - 1 - margin))
    mask = inner.all(axis=-1)
    assert np.count_nonzero(mask) > 0.7 * np.count_nonzero(shown(view))
    return np.asarray(mask)


@pytest.mark.parametrize(
    ("config", "width", "height", "step"), [(WHOLE, 320, 224, 1), (WHOLE, 832, 448, 2), (WHOLE, 1248, 480, 3)]
)
def test_a_whole_step_moves_whole_pixels_exactly(config: ViewConfig, width: int, height: int, step: int) -> None:
    view = make_view(config, width=width, height=height, camera=None)
    assert view.step_px == (step, step)
    target = view.target_coordinates(constant_flow(view, 4, (2.0, -1.0)), 4)
    np.testing.assert_allclose(
        target - pixel_grid(height, width), np.broadcast_to((2.0 * step, -1.0 * step), target.shape), atol=1e-4
    )


def test_shifting_the_source_by_whole_steps_shifts_the_view() -> None:
    image = textured_image(832 + 8, 448)
    view = make_view(WHOLE, width=832, height=448, camera=None)
    here, there = (view.render(np.ascontiguousarray(image[:, x : x + 832])) for x in (0, 8))
    np.testing.assert_array_equal(here[:, 4:], there[:, :-4])


def test_a_view_that_needs_no_resampling_is_the_image() -> None:
    image = textured_image(320, 224)
    np.testing.assert_array_equal(make_view(WHOLE, width=320, height=224, camera=None).render(image), image)


def test_the_crop_is_the_middle_of_the_image() -> None:
    image = textured_image(301, 259)
    view = make_view(CROP, width=301, height=259, camera=None)
    np.testing.assert_array_equal(view.render(image), image[17 : 17 + 224, 38 : 38 + 224])
    assert view.region() == (38, 17, 224, 224)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("config", "width", "height", "camera"), CASES)
def test_a_ramp_is_seen_where_it_is(
    config: ViewConfig, width: int, height: int, camera: PinholeCamera | None, axis: int
) -> None:
    view = make_view(config, width=width, height=height, camera=camera)
    slope = 250.0 / (width, height)[axis]
    rising = np.round(pixel_grid(height, width)[..., axis] * slope).astype(np.uint8)
    up, down = (view.render(image).astype(np.float64) for image in (rising, 250 - rising))
    assert up.shape == (view.height, view.width)
    seen = 125.0 + (up - down) / 2  # OpenCV rounds halves up: a falling ramp takes that bias out again
    expected = source_pixels(view, camera, pixel_grid(view.height, view.width).astype(np.float64))[..., axis] * slope
    difference_px = (seen - expected)[inner_part(view)] / slope
    assert abs(difference_px.mean()) < 2 * TOLERANCE_PX  # the ramp itself comes in whole gray levels
    assert np.abs(difference_px).max() * slope < 1.1


def covered(view: InternalView) -> NDArray[np.bool_]:
    """[h, w]: view pixels that show the source image rather than its repeated border."""
    if view.lens is not None:
        source = view.lens.source_of_view
    else:
        source = (pixel_grid(view.height, view.width) - view.middle_px) * view.step_px + view.center_px
    low, high = -0.5, np.array([view.source_width, view.source_height]) - 0.5
    return np.asarray(((source >= low) & (source <= high)).all(axis=-1))


def inner_part(view: InternalView) -> NDArray[np.bool_]:
    """View pixels that show the source image, without those next to its border."""
    seen = covered(view)
    inner = seen.copy()
    inner[1:], inner[:-1] = inner[1:] & seen[:-1], inner[:-1] & seen[1:]
    inner[:, 1:], inner[:, :-1] = inner[:, 1:] & seen[:, :-1], inner[:, :-1] & seen[:, 1:]
    return inner


@pytest.mark.parametrize(("config", "width", "height", "camera"), CASES)
def test_region_bounds_what_is_analysed(
    config: ViewConfig, width: int, height: int, camera: PinholeCamera | None
) -> None:
    view = make_view(config, width=width, height=height, camera=camera)
    x, y, region_width, region_height = view.region()
    assert 0 <= x < x + region_width <= width
    assert 0 <= y < y + region_height <= height
    mask = shown(view)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    assert (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1) == (x, y, x + region_width, y + region_height)
    at = view_pixels(view, camera)
    inside = ((at > -0.5) & (at < (view.width - 0.5, view.height - 0.5))).all(axis=-1)
    assert np.count_nonzero(mask != inside) <= 0.002 * mask.size


@pytest.mark.parametrize(
    ("width", "height"), [(65, 65), (225, 224), (1241, 376), (33, 97), (417, 417), (3000, 40), (32, 32)]
)
@pytest.mark.parametrize("with_camera", [False, True])
def test_sides_are_multiples_of_32(width: int, height: int, with_camera: bool) -> None:
    camera = PinholeCamera(fx=200.0, fy=210.0, cx=width / 2, cy=height / 2, width=width, height=height)
    view = make_view(WHOLE, width=width, height=height, camera=camera if with_camera else None)
    assert (view.width % SIDE_MULTIPLE_PX, view.height % SIDE_MULTIPLE_PX) == (0, 0)
    assert view.width <= (640 if with_camera else 416)
    assert view.height <= (512 if with_camera else 416)
    assert view.render(textured_image(width, height)).shape == (view.height, view.width)
    target = view.target_coordinates(constant_flow(view, 4, (0, 0)), 4)
    np.testing.assert_allclose(target, pixel_grid(height, width), atol=TOLERANCE_PX)


def test_what_lies_beyond_the_image_repeats_its_border() -> None:
    full, padded = (make_view(WHOLE, width=width, height=height, camera=None) for width, height in ((65, 65), (50, 40)))
    assert (full.width, full.height) == (padded.width, padded.height) == (64, 64)
    assert covered(full).all()
    assert np.count_nonzero(covered(padded)) == 50 * 40
    assert covered(padded)[12:52, 7:57].all()
    image = textured_image(50, 40)
    np.testing.assert_array_equal(padded.render(image), np.pad(image, ((12, 12), (7, 7)), mode="edge"))


def test_the_lens_shows_what_the_closed_form_says() -> None:
    view = make_view(WHOLE, width=752, height=480, camera=EUROC)
    at = source_pixels(view, EUROC, pixel_grid(view.height, view.width).astype(np.float64))
    expected = ((at >= -0.5) & (at <= (751.5, 479.5))).all(axis=-1)
    assert np.count_nonzero(covered(view) != expected) <= 4
    assert 0.5 < covered(view).mean() < 1.0


def test_the_same_camera_gives_the_same_view_object() -> None:
    first = make_view(WHOLE, width=752, height=480, camera=EUROC)
    assert make_view(WHOLE, width=752, height=480, camera=EUROC) is first


def test_cells_of_blocks_are_looked_up_once_for_each_size() -> None:
    lens = make_view(WHOLE, width=512, height=512, camera=FISHEYE).lens
    assert lens is not None
    shape = tuple(side // 4 for side in lens.source_of_view.shape[:2])
    fine = lens.cells_of_blocks(shape, 4, 4)
    assert lens.cells_of_blocks(shape, 4, 4) is fine
    assert fine.shape == (128, 128, 2)
    coarse = lens.cells_of_blocks(shape, 4, 8)
    every_pixel = lens.cells_of_blocks(shape, 4, 1)
    np.testing.assert_array_equal(coarse, every_pixel[4::8, 4::8])
    np.testing.assert_array_equal(lens.cells_of_blocks(shape, 4, 4), fine)


def test_a_view_says_what_it_holds() -> None:
    view = make_view(WHOLE, width=512, height=512, camera=FISHEYE)
    assert view.lens is not None
    mask = view.analyzed()
    assert mask is not None
    of_image = view.lens.view_of_source.nbytes
    tables = view.lens.source_of_view.nbytes + 2 * of_image + of_image // 16
    assert view.held_bytes == tables + mask.nbytes
    assert make_view(WHOLE, width=320, height=240, camera=SCALED).held_bytes == 0


def test_a_long_thin_image_is_shrunk_without_losing_its_rows() -> None:
    view = make_view(WHOLE, width=20_000, height=32, camera=None)
    assert view.render(np.full((32, 20_000), 90, dtype=np.uint8)).mean() == 90


@pytest.mark.parametrize(("width", "height"), [(223, 300), (300, 223)])
def test_an_image_smaller_than_the_crop_is_refused(width: int, height: int) -> None:
    with pytest.raises(InvalidInputError, match=f"at least 224x224.*found {width}x{height}") as caught:
        make_view(CROP, width=width, height=height, camera=None)
    assert (caught.value.code, caught.value.field) == ("image_smaller_than_crop", "image")


@pytest.mark.parametrize(("width", "height"), [(32_768, 32), (32, 32_768)])
def test_a_side_beyond_opencvs_limit_is_refused(width: int, height: int) -> None:
    with pytest.raises(TooLargeError, match="at most 32767 px") as caught:
        make_view(WHOLE, width=width, height=height, camera=None)
    assert (caught.value.code, caught.value.field) == ("image_too_large", "image")


FOLDING = [
    pytest.param("radtan", (-1.0, 0.0, 0.0, 0.0), id="barrel that folds"),
    pytest.param("radtan", (-50.0, 20.0, 0.0, 0.0, 0.0), id="folds twice"),
    pytest.param("radtan", (1e6, 1e6, 1e6, 1e6), id="not a lens"),
    pytest.param("equidistant", (-1.0, 0.0, 0.0, 0.0), id="fisheye that folds"),
    pytest.param("equidistant", (-1e6, 1e6, 1.0, 1.0), id="not a fisheye"),
]


@pytest.mark.parametrize(("model", "coefficients"), FOLDING)
def test_a_distortion_that_cannot_be_undone_is_refused(model: DistortionModel, coefficients: tuple[float, ...]) -> None:
    camera = PinholeCamera(120.0, 120.0, 79.5, 59.5, 160, 120, model, coefficients)
    with pytest.raises(InvalidInputError, match=f"can be undone over the whole image.*{model}") as caught:
        make_view(WHOLE, width=160, height=120, camera=camera)
    assert (caught.value.code, caught.value.field) == ("camera_invalid", "camera.distortion_coeffs")


def test_what_a_fisheye_sees_behind_itself_is_not_analysed() -> None:
    camera = PinholeCamera(60.0, 60.0, 127.5, 127.5, 256, 256, "equidistant", (0.01, 0.0, 0.0, 0.0))
    mask = make_view(WHOLE, width=256, height=256, camera=camera).analyzed()
    assert mask is not None
    assert mask[127, 127]
    angle = np.hypot(*(pixel_grid(256, 256) - 127.5).transpose(2, 0, 1)) / 60.0
    assert not mask[angle > 1.2].any()


@pytest.mark.parametrize("center", [(-1e6, 60.0), (80.0, 1e6)])
@pytest.mark.parametrize(
    ("focal_px", "model", "coefficients"), [(120.0, "none", ()), (1e5, "radtan", (1e-9, 0.0, 0.0, 0.0))]
)
def test_a_principal_point_far_from_the_image_is_refused(
    center: tuple[float, float], focal_px: float, model: DistortionModel, coefficients: tuple[float, ...]
) -> None:
    camera = PinholeCamera(focal_px, focal_px, *center, 160, 120, model, coefficients)
    with pytest.raises(InvalidInputError, match="principal point near enough") as caught:
        make_view(WHOLE, width=160, height=120, camera=camera)
    assert (caught.value.code, caught.value.field) == ("camera_invalid", "camera.cx")
