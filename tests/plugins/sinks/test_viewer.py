"""Recordings opened in the real viewer, headless; the pixels of the curves are counted."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from pgexcite.core.recording import PALETTE
from pgexcite.plugins.sinks.rerun import RerunSink
from pgexcite.studies.compare import overlay

pytestmark = pytest.mark.viewer

WIDTH, HEIGHT = 1600, 1000
TIMEOUT = 90.0
FEW = 150
"""Pixels; a curve across a plot has several hundred, the dot in its legend about forty."""

SHOT = """
import sys, rerun.experimental
rerun.experimental.ViewerClient(sys.argv[1]).save_screenshot(sys.argv[2])
"""


def screenshots(recording: Path, directory: Path):
    """Screenshots of the viewer, one after the other, until the time is up."""
    viewer = shutil.which("rerun", path=str(Path(sys.executable).parent)) or shutil.which("rerun")
    if viewer is None:
        pytest.fail("the viewer 'rerun' is not installed; it comes with the package rerun-sdk")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [viewer, recording, "--headless", "--window-size", f"{WIDTH}x{HEIGHT}", "--port", str(port)]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(directory), "HOME": str(directory)}
    with (
        (directory / "viewer.log").open("w") as log,
        subprocess.Popen(command, stdout=log, stderr=log, env=environment, start_new_session=True) as process,
    ):
        try:
            end = time.monotonic() + TIMEOUT
            while time.monotonic() < end and process.poll() is None:
                time.sleep(2.0)
                picture = directory / "shot.png"
                url = f"rerun+http://127.0.0.1:{port}/proxy"
                subprocess.run([sys.executable, "-c", SHOT, url, picture], check=False, capture_output=True)
                if picture.exists():
                    yield pixels(picture)
        finally:
            # "rerun" is a script that starts the viewer: ended alone, it would leave that behind.
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)


def pixels(picture: Path):
    from matplotlib.image import imread

    return np.round(imread(picture)[:, :, :3] * 255).astype(int)


def count(image, rgb, x, y):
    """Pixels near a colour in a part of the picture (fractions of its width and height)."""
    rows, columns = image.shape[:2]
    part = image[int(y[0] * rows) : int(y[1] * rows), int(x[0] * columns) : int(x[1] * columns)]
    return int(np.sum(np.max(np.abs(part - rgb), axis=2) < 40))


def wait_for(recording, directory, wanted):
    """Until every (colour, x, y) has its curve; the last counts are in the failure."""
    counts = []
    for image in screenshots(recording, directory):
        counts = [count(image, *item) for item in wanted]
        if min(counts) >= FEW:
            return
    log = (directory / "viewer.log").read_text()
    pytest.fail(
        f"not all curves were drawn; pixels found: {counts}, at least {FEW} wanted of each; the viewer says:\n{log}"
    )


def test_every_panel_of_a_run_shows_its_curve(synthetic_run, tmp_path):
    path = RerunSink().write(synthetic_run(title="viewer test", gain=30.0, mpc=True), tmp_path)
    unit, current = PALETTE[0], PALETTE[5]
    rows = [(0.06 + 0.19 * k, 0.06 + 0.19 * (k + 1)) for k in range(4)]
    left, right = (0.41, 0.69), (0.71, 0.99)
    wanted = [(unit, column, rows[k]) for k in range(3) for column in (left, right)]
    wanted.append((current, right, rows[1]))
    wanted.append((unit, (0.0, 0.39), (0.06, 0.33)))  # the unit's symbol in the single-line diagram
    wanted += [
        (rgb, (0.0, 0.39), (0.4, 0.95)) for rgb in ((90, 160, 255), (255, 150, 50), (235, 90, 105), (90, 210, 120))
    ]
    wait_for(path, tmp_path, wanted)


def test_an_overlay_shows_every_run(synthetic_run, tmp_path):
    runs = {
        name: synthetic_run(gain=gain, clearing=c).trace
        for name, gain, c in (("a", 0, 0.06), ("b", 30, 0.1), ("c", 60, 0.15))
    }
    path = overlay(runs, ["G2"], tmp_path / "compare.rrd", "overlay test")
    rows = [(0.06 + 0.195 * k, 0.06 + 0.195 * (k + 1)) for k in range(4)]
    wait_for(path, tmp_path, [(PALETTE[k], (0.0, 0.9), row) for k in range(3) for row in rows])
