"""What `make demo` runs: the demo city, rendered full and culled, what that changed and what it saved."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from ...page.report_page import write
from ..studies import compare
from ..studies.compare import CULLED, FULL, OTHER_SEED


def main(argv: Sequence[str] | None = None) -> int:
    """Write full.png, culled.png, flip.png, tlas.png, report.json and report.html, and print the table;
    returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/demo"))
    parser.add_argument("--instances", default="300000")
    parser.add_argument("--resolution", default="640x360")
    parser.add_argument("--samples", default="24")
    args = parser.parse_args(argv)
    out: Path = args.output
    start = time.perf_counter()
    scene = out / "mirror-city.blend"
    options = ("--resolution", args.resolution, "--samples", args.samples)

    def say(text: str) -> None:
        print(f"[{time.perf_counter() - start:4.0f} s] {text}", file=sys.stderr, flush=True)

    say("compiling kernels: once, they are kept")
    compare.lipac("demo", "mirror-city", "-o", out / "kernels" / "city.blend", "--instances", "1000")
    compare.lipac("analyze", out / "kernels" / "city.blend", "-o", out / "kernels", "--quiet")
    shutil.rmtree(out / "kernels")
    say(f"the demo city, {int(args.instances):,} instances")
    compare.lipac("demo", "mirror-city", "-o", scene, "--instances", args.instances)
    say("culling it by its light paths, then Cycles")
    culled = compare.render(scene, out, CULLED, options)
    say("Cycles, all of it")
    full = compare.render(scene, out, FULL, options)
    say("Cycles, all of it, with other random numbers: how far two pictures of one scene are apart")
    compare.render(scene, out, OTHER_SEED, options)
    say("comparing")
    error = compare.errors(out)
    _pictures(scene, out)
    report = {key: value for key, value in culled.items() if key != "process_s"}
    report["frames"][0]["error"] = error[CULLED]
    report["demo"] = {"full": full, "culled_process_s": culled["process_s"], "error_between_seeds": error[OTHER_SEED]}
    (out / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    write(out, out / FULL, out / CULLED)
    say("done")
    print(compare.table(full, culled, error))
    print(
        f"\n{out}: full.png, culled.png, flip.png (their difference), tlas.png (what is active, from outside), "
        "report.json, and report.html, which shows all of it"
    )
    return 0


def _pictures(scene: Path, out: Path) -> None:
    from matplotlib.image import imsave

    for name in (FULL, CULLED):
        shutil.copyfile(out / name / "frame_0001.png", out / f"{name}.png")
    imsave(out / "flip.png", compare.flip_picture(out))
    imsave(out / "tlas.png", compare.tlas_of(scene, out / CULLED / "states" / "frame_0001.npz", 1))


if __name__ == "__main__":
    sys.exit(main())
