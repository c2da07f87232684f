"""The time keeper of a run of ROS 1: a required node that ends the run when its length is over.

`ros_driver.py` makes a package of this file. The exit status of roslaunch is 0 even if all nodes have died, so the node writes
a file: the text that the driver expects only when the whole time is over. Its sleeps are
short, because a longer one would delay SIGINT.
"""

import os
import sys
import time
from pathlib import Path
from typing import Callable, NoReturn

import rospy

TICK_S, CLOSE_S = 0.05, 30.0
rospy.init_node("sierra_timekeeper")
length = float(rospy.get_param("/sierra/length"))
patience = float(os.environ["SIERRA_ROS_PATIENCE"])


def wait(seconds: float, until: Callable[[], object]) -> bool:
    """Wait until a condition holds; return whether it does within these seconds."""
    end = time.monotonic() + seconds
    while not rospy.is_shutdown() and not until():
        if time.monotonic() > end:
            return False
        time.sleep(TICK_S)
    return not rospy.is_shutdown()


def has_param(name: str) -> Callable[[], object]:
    """Return a condition: the driver has set a parameter."""
    return lambda: rospy.get_param(name, False)


def end(text: str, status: int) -> NoReturn:
    """End the run, with the text that the driver expects at the end of the time, or with the reason of a failure."""
    Path(os.environ["SIERRA_ROS_MARKER"]).write_text(text)
    sys.exit(status)


def end_robots() -> None:
    """Let the robots that use this master end their nodes, so that their files are complete. Ends the run if one does not."""
    robots = os.environ["SIERRA_ROS_ROBOTS"].split()
    rospy.set_param("/sierra/over", True)
    for robot in robots:
        if not wait(CLOSE_S, has_param(f"/sierra/{robot}/closed")):
            end(f"{robot} has not ended its nodes within {CLOSE_S:g} s", 1)


if not wait(float("inf"), has_param("/sierra/started")):
    sys.exit(1)
now = rospy.get_time if rospy.get_param("/use_sim_time", False) else time.monotonic  # ROS's own time jumps if a clock is set
if not wait(patience, lambda: now() > 0):
    end("nothing has published the simulated time (/clock)", 1)
begin = now()
if os.environ["SIERRA_ROS_AWAIT"]:
    real = time.monotonic()
    done = has_param("/sierra/finished")
    if not wait(float("inf"), lambda: done() or min(now() - begin, time.monotonic() - real) > length + patience):
        sys.exit(1)
    if not done():
        end(f"awaited nodes have not ended {patience:g} s after the length of the run: {os.environ['SIERRA_ROS_AWAIT']}", 1)
elif not wait(float("inf"), lambda: now() - begin >= length):
    sys.exit(1)
end_robots()
end(os.environ["SIERRA_ROS_RUN"], 0)
