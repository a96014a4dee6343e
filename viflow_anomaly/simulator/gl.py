"""Gets mujoco and an OpenGL context without a display, or says what to install."""

from __future__ import annotations

import ctypes.util
import os
import sys
from typing import Any

from viflow_anomaly.errors import MissingDependencyError


def load_mujoco() -> Any:
    """Import mujoco with an offscreen GL backend: MUJOCO_GL as the user set it, else EGL, else OSMesa.

    Raises:
        MissingDependencyError: ``mujoco_missing`` (with the install line) or ``gl_missing`` (with the packages).
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = _offscreen_backend()
    try:
        import mujoco  # noqa: PLC0415
    except ModuleNotFoundError as err:
        if err.name != "mujoco":
            raise
        raise MissingDependencyError(
            'the simulator needs mujoco, which is not installed: pip install "viflow-anomaly[simulate]"',
            code="mujoco_missing",
        ) from err
    except (ImportError, AttributeError, OSError, RuntimeError) as err:  # PyOpenGL without its library
        raise gl_missing(str(err)) from err
    return mujoco


def _offscreen_backend() -> str:
    for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if ctypes.util.find_library(library):
            return backend
    raise gl_missing("neither libEGL nor libOSMesa was found")


def gl_missing(problem: str) -> MissingDependencyError:
    return MissingDependencyError(
        "the simulator needs OpenGL without a display: install the Debian packages libegl1 and libgl1-mesa-dri, or "
        f"libosmesa6, or set MUJOCO_GL yourself (now {os.environ.get('MUJOCO_GL')!r}); found: {problem}",
        code="gl_missing",
    )
