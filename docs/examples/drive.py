"""Drive ten seconds beside the recorded path of a reconstruction, and write what the front camera sees as a video.

python docs/examples/drive.py RUN --scene SCENE --out drive.mp4

RUN is the folder of a run, or of a fit with the scene it belongs to. The vehicle changes lanes and keeps its distance
to whoever it sees.
"""

import argparse
from pathlib import Path

from mudg import sim
from mudg.formats.exporters.video import write_mp4
from mudg.sim.drive import Following
from mudg.sim.pilots import DriverView, RoutePilot

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("run", type=Path)
parser.add_argument("--scene", type=Path)
parser.add_argument("--out", type=Path, required=True)
parser.add_argument("--seconds", type=float, default=10.0)
parser.add_argument("--shift-m", type=float, default=3.0, help="where it aims, metres to the left of the path")
given = parser.parse_args()

STEP_S = 0.1
cockpit = sim.Cockpit(sim.Session(given.run, scene=given.scene), layers=("rgb", "depth", "classes"))
(name, camera), *_ = cockpit.cameras.items()
drive = cockpit.drive(traffic="idm")
pilot = RoutePilot(Following(speed_mps=max(drive.motion.speed_mps, 5.0)), shift_m=given.shift_m)
last_s, pictures = cockpit.session.time_range_s[1], []
while len(pictures) * STEP_S < given.seconds and drive.time_s + STEP_S <= last_s:
    seen = cockpit.see(drive)[name].layers
    motion, route = drive.motion, drive.road.route(drive.pose)
    now = (drive.time_s, STEP_S, motion.speed_mps, motion.steer_rad, route, drive.pose)
    drive.step(pilot.drive(DriverView(*now, camera, cockpit.mounts[name], **seen)), STEP_S)
    pictures.append(seen["rgb"])
    if drive.collision():
        break
_, shift_m = drive.road.locate((drive.motion.x_m, drive.motion.y_m))
write_mp4(given.out, pictures, fps=1 / STEP_S)
print(f"{len(pictures)} pictures, {shift_m:+.1f} m beside the path, hit: {drive.collision() or 'nothing'}")
