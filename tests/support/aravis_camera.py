"""A GigE Vision camera that is not ours, with pixels that are: Aravis's fake camera, in a process of its own.

`python aravis_camera.py SECONDS`: serves 127.0.0.1 and prints `ready`. Pixel i of a Mono16 frame of exposure t (us)
shows min(4095, floor(BLACK + t * rate(i))), the digital numbers of a linear 12-bit sensor.
"""

from __future__ import annotations

import ctypes
import sys
import time

import numpy as np
from numpy.typing import NDArray

BLACK, FULL = 64, 4095
LIBRARY = "libaravis-0.8.so.0"


def rate(pixels: int) -> NDArray[np.float64]:
    """(pixels,) digital numbers per microsecond, from a hundredth to a thousand: five decades."""
    return 10.0 ** np.linspace(-2, 3, pixels)


def expected(pixels: int, exposure_us: float) -> NDArray[np.uint16]:
    """(pixels,) what one frame shows."""
    return np.minimum(FULL, np.floor(BLACK + exposure_us * rate(pixels))).astype(np.uint16)


def serve(seconds: float) -> None:
    """Answer GigE Vision on the loopback for a while."""
    arv, pointer = ctypes.CDLL(LIBRARY), ctypes.c_void_p
    callback = ctypes.CFUNCTYPE(None, pointer, pointer, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32)
    for name, result, arguments in (
        ("arv_gv_fake_camera_new", pointer, [ctypes.c_char_p, ctypes.c_char_p]),
        ("arv_gv_fake_camera_get_fake_camera", pointer, [pointer]),
        ("arv_fake_camera_set_fill_pattern", None, [pointer, callback, pointer]),
        ("arv_buffer_get_data", pointer, [pointer, pointer]),
        ("arv_buffer_get_image_width", ctypes.c_int, [pointer]),
        ("arv_buffer_get_image_height", ctypes.c_int, [pointer]),
    ):
        function = getattr(arv, name)
        function.restype, function.argtypes = result, arguments

    def fill(buffer: int, _: int, exposure_us: int, gain: int, pixel_format: int) -> None:
        data = arv.arv_buffer_get_data(buffer, None)  # its size is known once the buffer is full
        pixels = arv.arv_buffer_get_image_width(buffer) * arv.arv_buffer_get_image_height(buffer)
        out = np.ctypeslib.as_array(ctypes.cast(data, ctypes.POINTER(ctypes.c_uint16)), (pixels,))
        out[:] = expected(len(out), exposure_us)

    keep = callback(fill)
    camera = arv.arv_gv_fake_camera_new(b"127.0.0.1", b"DISCO1")
    arv.arv_fake_camera_set_fill_pattern(arv.arv_gv_fake_camera_get_fake_camera(camera), keep, None)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    time.sleep(seconds)


if __name__ == "__main__":
    serve(float(sys.argv[1]))
