"""Camera images to a semantic voxel grid on a CPU, with the same bits every time.

    model = voxcast.Model.shipped()
    scene = voxcast.Scene.street(model)
    session = voxcast.Session(model, voxcast.Rig.build(model, scene))
    occupancy = session.run(scene)
    occupancy.classes          # uint8 [X, Y, Z], z fastest, in the lidar's frame; 0 is empty
    voxcast.view(occupancy, scene)

Images are uint8 [cameras, height, width, 3], "bgr" or "rgb" as the caller says. A calibration is float32 [cameras, 4, 4] per
camera, lidar-frame metres (x, y, z, 1) to (u d, v d, d, 1). What goes wrong raises a subclass of `voxcast.Error` with one
line that says what was found and what was expected. What is allowed and not obeyed is a warning, `voxcast.Note`.
"""

from ._errors import BusyError, Error, FileError, FormatError, MismatchError, Note, TooLargeError, UnsupportedError
from ._evaluate import evaluate
from ._import import import_checkpoint
from ._native import (
    CameraStatus,
    Evaluation,
    Memory,
    Model,
    Occupancy,
    Page,
    Report,
    Rig,
    Scene,
    Session,
    Worker,
    __version__,
    calibrate_confidence,
    merge,
    view,
)

__all__ = [
    "BusyError",
    "CameraStatus",
    "Error",
    "Evaluation",
    "FileError",
    "FormatError",
    "Memory",
    "MismatchError",
    "Model",
    "Note",
    "Occupancy",
    "Page",
    "Report",
    "Rig",
    "Scene",
    "Session",
    "TooLargeError",
    "UnsupportedError",
    "Worker",
    "__version__",
    "calibrate_confidence",
    "evaluate",
    "import_checkpoint",
    "merge",
    "view",
]
