"""A real video of real people goes through a real detector to a report.

Run by ``make test``; not a pytest module, since it needs packages that nothing else does: MediaPipe 0.10.21,
which has its models inside (Apache-2.0), and Sports2D, whose demonstration video this is (BSD-3, (c) 2022
perfanalytics). They are installed without their dependencies into an environment on top of this one. Where
they cannot be installed, the check is skipped and says why.
"""

import os
import subprocess
import sys
import sysconfig
import tempfile
import venv
from fractions import Fraction
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("mediapipe==0.10.21", "protobuf>=4.25.3,<5", "absl-py", "attrs", "flatbuffers", "sports2d>=0.8")


def packages_on_top(folder: Path) -> tuple[Path, Path] | str:
    """Return the Python of a new environment and the video, or why there is none."""
    venv.create(folder, with_pip=True)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    options = ["--quiet", "--retries=1", "--no-deps", "--only-binary=:all:"]
    install = [str(python), "-m", "pip", "install", *options, *PACKAGES]
    done = subprocess.run(install, capture_output=True, text=True)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        return (errors or ["pip failed"])[-1]
    place = {"base": str(folder), "platbase": str(folder)}
    own = sysconfig.get_path("purelib", "venv", place)
    here = sysconfig.get_path("purelib")
    Path(own, "zz_below.pth").write_text(f"import site; site.addsitedir({here!r})\n")
    return python, Path(own, "Sports2D", "Demo", "demo.mp4")


def turned_copy(video: Path, path: Path, frames: int) -> None:
    """Write the first frames as a phone on its side does: turned images, and the turn that undoes it."""
    import av
    import numpy as np

    with av.open(str(video)) as source, av.open(str(path), "w") as target:
        stream = target.add_stream("mpeg4", rate=30)
        stream.bit_rate = 30_000_000
        stream.codec_context.time_base = Fraction(1, 30)
        for index, frame in zip(range(frames), source.decode(video=0), strict=False):
            image = np.ascontiguousarray(np.rot90(frame.to_ndarray(format="bgr24"), -1))
            if index == 0:
                stream.height, stream.width = image.shape[:2]
                stream.set_display_rotation(90)
            turned = av.VideoFrame.from_ndarray(image, format="bgr24")
            turned.pts, turned.time_base = index, Fraction(1, 30)
            target.mux(stream.encode(turned))
        target.mux(stream.encode(None))


def check_detections(path: Path, turned: Path) -> None:
    """Check that people are upright, two, and at the same places in the turned copy."""
    import numpy as np

    from rtof_kin.vision.keypoint_files import read_detector_file

    found, again = read_detector_file(path), read_detector_file(turned)
    assert len(found) == 230
    assert np.allclose(np.diff(found.times), 1 / 30, atol=1e-3)
    assert found.present.any(axis=1).mean() > 0.9, "people are found in nearly all frames"
    assert (found.present.sum(axis=1) >= 2).mean() > 0.3, "two people are found"
    nose, ankles = found.uv_px[:140, :, 0, 1], found.uv_px[:140, :, 27:29, 1].mean(axis=-1)
    assert (nose < ankles)[np.isfinite(ankles)].mean() > 0.95, "they stand on their feet until he jumps"
    distance = np.linalg.norm(found.uv_px[: len(again), 0] - again.uv_px[:, 0], axis=-1)
    apart = np.nanmedian(distance)
    assert apart < 5, f"a turned video gives the same points, not {apart:.1f} px apart"


def main() -> None:
    """Detect, reconstruct, report; raises where anything fails."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = packages_on_top(folder / "env")
        if isinstance(made, str):
            print(f"real video: skipped, its packages cannot be installed here ({made})")
            print("0 passed, 0 failed, 1 skipped")
            return
        python, video = made
        environment = os.environ | {
            "PYTHONPATH": str(ROOT),
            "RTOF_KIN_CACHE": str(folder / "cache"),
            "OMP_NUM_THREADS": "1",
            "RTOF_KIN_COMPILE": "never",
        }

        def run(*arguments: str | Path) -> None:
            order = [str(part) for part in (python, "-m", "rtof_kin.cli", *arguments)]
            subprocess.run(order, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)

        turned_copy(video, folder / "turned.mp4", 40)
        run("detect", video, "-o", "keypoints.npz")
        run("detect", "turned.mp4", "-o", "turned.npz")
        sys.path.insert(0, str(ROOT))
        check_detections(folder / "keypoints.npz", folder / "turned.npz")
        given = (video, "keypoints.npz", video.with_name("Calib_demo.toml"))
        run("run", *given, "--height", "1.65", "--person", "2", "-o", "out")
        assert (folder / "out" / "report.html").stat().st_size > 50_000
    print("1 passed, 0 failed")


if __name__ == "__main__":
    main()
