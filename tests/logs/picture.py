"""Turns a log into a recording that Rerun's viewer opens at one 3-D view of the voxels, for a picture without a display:

    python tests/logs/picture.py out.mcap out.rrd
    rerun out.rrd --headless --screenshot-to out.png --renderer vulkan
"""

import sys

import rerun as rr
import rerun.blueprint as rrb

log, recording = sys.argv[1:]
view = rrb.Spatial3DView(
    name="occupancy",
    origin="/voxcast/occupancy",
    contents=["/voxcast/occupancy"],
    background=[255, 255, 255],
    line_grid=False,
    eye_controls=rrb.EyeControls3D(position=(-22, -52, 34), look_target=(0, 2, -4), eye_up=(0, 0, 1)),
    spatial_information=rrb.SpatialInformation(target_frame="lidar"),
)
blueprint = rrb.Blueprint(view, collapse_panels=True, auto_views=False, auto_layout=False)
rr.init("voxcast")
rr.save(recording, default_blueprint=blueprint)
rr.log_file_from_path(log)
rr.disconnect()
