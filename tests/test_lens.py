"""Lens tables against closed forms: both ways through a distortion, and flow across it."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import EUROC

from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.geometry import pixel_grid, sample_bilinear
from viflow_anomaly.lens import LENS_LATTICE_PX, LensMaps, lattice_rays, solve_lens_maps
from viflow_anomaly.sensor_data import PinholeCamera

FISHEYE = PinholeCamera(190.0, 190.0, 255.0, 250.0, 512, 480, "equidistant", (0.0034, 0.0007, -0.0021, 0.0002))


def maps_of(camera: PinholeCamera) -> LensMaps:
    step_px = (camera.fx / 150.0, camera.fy / 150.0)
    return solve_lens_maps(camera, lattice_rays(camera), width=320, height=256, step_px=step_px)


@pytest.mark.parametrize(("camera", "most_px"), [(EUROC, 0.03), (FISHEYE, 0.3)], ids=["radtan", "equidistant"])
def test_the_tables_undo_each_other(camera: PinholeCamera, most_px: float) -> None:
    maps = maps_of(camera)
    assert maps.source_of_view.shape == (256, 320, 2)
    assert maps.view_of_source.shape == (camera.height, camera.width, 2)
    inside = ((maps.source_of_view >= 0) & (maps.source_of_view <= (camera.width - 1, camera.height - 1))).all(axis=-1)
    back = sample_bilinear(maps.view_of_source, maps.source_of_view)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(back[inside], pixel_grid(256, 320)[inside], atol=most_px)


@pytest.mark.parametrize("stride", [1, 4])
@pytest.mark.parametrize("camera", [EUROC, FISHEYE], ids=["radtan", "equidistant"])
def test_a_flow_of_one_view_pixel_ends_on_the_next_one(camera: PinholeCamera, stride: int) -> None:
    maps = maps_of(camera)
    flow = np.zeros((256 // stride, 320 // stride, 2), dtype=np.float32)
    flow[..., 0] = 1.0
    spread = maps.spread(flow, stride)
    assert spread.shape == (camera.height, camera.width, 2)
    at = maps.source_of_view[40:-40, 40:-41]
    moved = at + sample_bilinear(spread, np.ascontiguousarray(at))
    np.testing.assert_allclose(moved, maps.source_of_view[40:-40, 41:-40], atol=0.03)
    np.testing.assert_array_equal(maps.spread(flow, stride), spread)


def test_the_lattice_reaches_beyond_the_last_pixel() -> None:
    rows, columns, _ = lattice_rays(EUROC).shape
    for count, side in ((rows, EUROC.height), (columns, EUROC.width)):
        assert 0 <= (count - 1) * LENS_LATTICE_PX - (side - 1) < LENS_LATTICE_PX


def test_a_lens_that_folds_is_refused() -> None:
    camera = PinholeCamera(120.0, 120.0, 79.5, 59.5, 160, 120, "radtan", (-1.0, 0.0, 0.0, 0.0))
    with pytest.raises(InvalidInputError, match="can be undone over the whole image") as caught:
        lattice_rays(camera)
    assert (caught.value.code, caught.value.field) == ("camera_invalid", "camera.distortion_coeffs")
