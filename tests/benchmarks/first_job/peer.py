"""Mitsuba as its own users run it: load a file, render passes with its path tracer until the time is over.

``python peer.py scene.xml image.npy --seconds 15`` needs Mitsuba and nothing of this project. Where Dr.Jit finds an
LLVM before 17 by itself, the caller sets ``DRJIT_LIBLLVM_PATH``. Prints its figures as JSON on the last line.
"""

from __future__ import annotations

import time

FIRST_LINE = time.monotonic()

import argparse  # noqa: E402 - the clock runs before anything is imported
import json  # noqa: E402
from pathlib import Path  # noqa: E402

import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402

RESERVE = 0.95
"""Share of the time left that a pass is sized for: rates vary by a few percent. ``elps render`` has the same."""
PASS_SECONDS = 2.0
"""Longest pass. Starting one takes about 20 ms, a hundredth of it; its paths take about 1 GB at 5 million a second."""
TRIAL_PASSES = 2
"""Passes of one sample per pixel: the first compiles, the second tells the rate."""


def main() -> None:
    """Render, write the mean image as float32 [height, width, 3] in linear RGB, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("image", type=Path)
    parser.add_argument("--seconds", type=float, required=True, help="from the start of the process to the image")
    parser.add_argument("--began", type=float, default=FIRST_LINE, help="the monotonic clock when it was started")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--max-depth", type=int, default=16)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    given = parser.parse_args()

    mi.set_variant(given.variant)
    imported = time.monotonic()
    scene = mi.load_file(str(given.scene))
    integrator = mi.load_dict({"type": "path", "max_depth": given.max_depth})
    loaded = time.monotonic()
    total, spp, passes, count, first = None, 0, 0, 1, 0.0
    while count >= 1:
        begin = time.monotonic()
        # Seeds of another run must not meet those of this one's passes.
        seed = (given.seed << 20) + passes
        part = np.array(mi.render(scene, integrator=integrator, spp=count, seed=seed), dtype=np.float64)[..., :3]
        total = count * part if total is None else total + count * part
        now = time.monotonic()
        first = first or now - begin
        spp, passes = spp + count, passes + 1
        left = given.began + given.seconds - now
        if passes < TRIAL_PASSES:
            count = int(left > 0)
        else:
            count = int(count / (now - begin) * min(RESERVE * left, PASS_SECONDS))
    assert total is not None
    np.save(given.image, (total / spp).astype(np.float32))
    figures = {
        "seconds_total": time.monotonic() - given.began,
        "seconds_importing": imported - given.began,
        "seconds_loading": loaded - imported,
        "seconds_first_pass": first,
        "spp": spp,
        "passes": passes,
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
