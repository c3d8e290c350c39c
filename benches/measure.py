"""Measures the tables of `docs/benchmarks.md`, and those of thresholds in `docs/method.md`, and prints their rows.

    cargo build --release
    python benches/measure.py [SUBJECT ...] [--seeds 1,2,3,4,5] [--work results/measure]

Subjects: drive_0005, kitti_07, odometry, benchmark, ground, demo, poisson, rays, basin, starts, thresholds; all by default.
A subject whose recording, package or program is absent is skipped with a line that names it. Recordings are below the
folder in `FPMCL_DATA`, by default `../shared/data`; the simulated drives are made in the folder of the work, where finished
maps are kept for the next call. The numbers of one call belong to one commit and one machine, which head the output.
Times are those of an otherwise idle machine.
"""

import argparse
import csv
import importlib.util
import json
import math
import os
import pathlib
import platform
import re
import shutil
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

ROOT = pathlib.Path(__file__).resolve().parent.parent
DATA = pathlib.Path(os.environ.get("FPMCL_DATA", ROOT / "../shared/data")).resolve()
PROGRAM = ROOT / "target/release/fpmcl"
DRIVE_0005 = DATA / "kitti-0926-drive-0005"
TRUTH_0005 = ["--truth", DRIVE_0005 / "poses.txt", "--calib", DRIVE_0005 / "calib.txt"]


class Absent(Exception):
    """A file, package or program that a subject needs."""


def require(path):
    """Returns `path`, which must exist."""
    if not path.exists():
        raise Absent(path)
    return path


def run(*command, **environment):
    """Runs a command in the root of the repository and returns its standard output."""
    words = [str(word) for word in command]
    print("$", *words, file=sys.stderr)
    environment = {**os.environ, **environment}
    return subprocess.run(
        words, cwd=ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def fpmcl(*arguments):
    return run(require(PROGRAM), *arguments)


def bench(name, *arguments, **environment):
    return run("cargo", "bench", "--bench", name, "--", *arguments, **environment)


def settings(*values):
    return [word for value in values for word in ("--set", value)]


def row(*cells):
    print("|", " | ".join(str(cell) for cell in cells), "|")


def table(*heads):
    row(*heads)
    row(*["---"] * len(heads))


def block(text):
    print("```text", text.rstrip(), "```", sep="\n")


def errors(name, folders, run_of):
    """Prints the errors of `run_of` (`mcl` or `refined`) over the reports of all seeds: mean (worst)."""
    reports = [json.loads((folder / "report.json").read_text()) for folder in folders]
    metrics = [report[run_of]["metrics"] for report in reports]
    position_cm = [100 * it["position_m"]["rmse"] for it in metrics]
    heading_deg = [math.degrees(it["heading_rad"]["rmse"]) for it in metrics]
    median_ms = statistics.median(1e3 * it["runtime_s"]["median"] for it in metrics)
    row(
        name,
        f"{statistics.mean(position_cm):.2f} ({max(position_cm):.2f}) cm",
        f"{statistics.mean(heading_deg):.3f} ({max(heading_deg):.3f}) deg",
        f"{median_ms:.0f} ms",
    )


def localized(work, seeds, name, localize, refine):
    """Localizes and refines once per seed; `localize` and `refine` are the arguments before the seed and the output."""
    folders = []
    for seed in seeds:
        folder = work / f"{name}_{seed}".replace(" ", "_")
        result = folder / "localization.npz"
        outputs = ["--output", result, "--seed", seed, "--force"]
        fpmcl("localize", *localize, *outputs)
        fpmcl("refine", result, *refine, "--seed", seed)
        folders.append(folder)
    errors(f"{name}: `localize`", folders, "mcl")
    errors(f"{name}: `refine`", folders, "refined")


def map_of(recording, file, *arguments):
    """Builds a map, if there is none yet, and prints its rate."""
    if not file.exists():
        fpmcl("build-map", recording, "--output", file, *arguments)
    report = json.loads(file.with_suffix(".report.json").read_text())
    seconds = report["seconds"]
    print(f"`build-map`: {report['mapped_frames']} key scans of {report['frames']} in {seconds:.1f} s\n")
    return file


def map_0005(work):
    return map_of(require(DRIVE_0005), work / "drive_0005/map.ply", *settings("frame_step=2", "depth=10"))


def drive_0005(work, seeds):
    odd = [DRIVE_0005, "--map", map_0005(work), *settings("start_idx=1", "frame_step=2"), *TRUTH_0005]
    stereo = ["--odometry", DRIVE_0005 / "odometry_stereo.txt"]
    table("odometry", "position RMSE", "heading RMSE", "time per frame")
    localized(work / "drive_0005", seeds, "scans", odd, [])
    localized(work / "drive_0005", seeds, "stereo camera", odd + stereo, [])
    localized(work / "drive_0005", seeds, "noisy truth", odd + settings("odometry=ground_truth"), [])


def kitti_07_drives(work):
    """Simulates both drives along the path of KITTI 07 where the poses of the benchmark are."""
    benchmark = DATA / "kitti-odometry-poses"
    poses = require(benchmark / "poses/07.txt")
    calib = require(benchmark / "sequences/07/calib.txt")
    parent = work / "kitti_07"
    for drive in (1, 2):
        if not (parent / f"drive_{drive}").exists():
            chosen = settings(
                f"drive={drive}",
                f"output_folder={parent}",
                f"path_pose_file={poses}",
                f"path_calib_file={calib}",
                "scanner.rolling_shutter=true",
            )
            fpmcl("simulate", "config/kitti_07/simulation.yml", *chosen)
    return work / "kitti_07/drive_1", work / "kitti_07/drive_2"


def given(drive):
    return ["--poses", drive / "poses.txt", "--calib", drive / "calib.txt"]


def kitti_07(work, seeds):
    first, second = kitti_07_drives(work)
    file = map_of(first, work / "kitti_07/map.ply", *given(first))
    truth = ["--truth", second / "poses.txt", "--calib", second / "calib.txt"]
    table("odometry", "position RMSE", "heading RMSE", "time per frame")
    odometry = ["--odometry", second / "odometry.txt"]
    localized(work / "kitti_07", seeds, "drifting", [second, "--map", file, *truth, *odometry], [])
    localized(work / "kitti_07", seeds, "scans", [second, "--map", file, *truth], [])


def odometry(work, _seeds):
    table("recording", "scans", "path", "segments of 5 to 50 m", "time per scan (median)")
    for name, truth in {
        "kitti-0926-drive-0005": TRUTH_0005,
        "vlp16-raw": [],
        "os1-thinned": [],
        "hdl32-gaps": [],
        "livox-hku1": [],
    }.items():
        recording = DATA / name
        if not recording.exists():
            print(f"skipped: {recording} is absent", file=sys.stderr)
            continue
        folder = work / "odometry" / name
        fpmcl("odometry", recording, "--output", folder, "--force")
        report = json.loads((folder / "report.json").read_text())
        segments = "-"
        if truth:
            evaluated = folder / "evaluation"
            poses = folder / "odometry_tum.txt"
            fpmcl("evaluate", poses, *truth, "--recording", recording, "--align", "first", "--output", evaluated)
            found = json.loads((evaluated / "report.json").read_text())
            found = found["trajectory"]["short_segments"]
            turn = 100 * found["rotation_deg_per_m"]
            segments = f"{found['translation_percent']:.2f} %, {turn:.2f} deg per 100 m"
        median_s, _p95_s = report["seconds_per_scan"]
        row(name, report["scans"], f"{report['path_m']:.0f} m", segments, f"{1e3 * median_s:.0f} ms")


def kitti_raw_drive(work):
    """Simulates a drive in the layout of KITTI's raw data."""
    folder = work / "kitti_raw"
    day = folder / "2011_09_26"
    if not day.exists():
        chosen = settings(f"output_folder={folder}", "n_scans=300", "scanner.rolling_shutter=true")
        fpmcl("simulate", "--force", *chosen)
        run(sys.executable, "benches/kitti_raw.py", folder / "drive_1", folder)
    return day / "2011_09_26_drive_0001_sync"


def benchmark_row(name, file):
    """Prints the figures of a benchmark from its file; across sessions those after a rigid alignment."""
    report = json.loads(file.read_text())
    odometry = "-"
    if report["odometry"]["scan_by_scan"]:
        trajectory = report["odometry"]["scan_by_scan"]["trajectory"]
        segments, lengths = trajectory["kitti_segments"], ""
        if not segments:
            segments, lengths = trajectory["short_segments"], " (5 to 50 m)"
        turn = 100 * segments["rotation_deg_per_m"]
        odometry = f"{segments['translation_percent']:.2f} %, {turn:.2f} deg per 100 m{lengths}"
    aligned = report["localization_aligned"]
    localization = aligned or report["localization"]

    def error(run_of):
        if not localization[run_of]:
            return "-"
        metrics = localization[run_of]["metrics"]
        position_cm = 100 * metrics["position_m"]["rmse"]
        heading_deg = math.degrees(metrics["heading_rad"]["rmse"])
        return f"{position_cm:.2f} cm, {heading_deg:.3f} deg"

    frames = localization["summary"]
    seconds = sum(report["stage_seconds"].values())
    tracking = f"{frames['tracking']} of {frames['frames']}"
    name += ", aligned" if aligned else ""
    row(name, odometry, error("mcl"), error("refined"), tracking, f"{seconds:.0f} s")


def benchmark(work, _seeds):
    first, second = DATA / "livox-hku1", DATA / "livox-hku2"
    truths = ["--truth", first / "optimized_poses.txt", "--second-truth", second / "optimized_poses.txt"]
    table("recording", "odometry", "localization", "refined", "frames tracking", "time")
    for name, recording, arguments in [
        ("nuScenes, one scene", DATA / "nuscenes-hdl32", []),
        ("drive 0005", DRIVE_0005, []),
        ("livox-hku2 in the map of livox-hku1", first, ["--second", second, *truths]),
        ("KITTI raw, simulated", kitti_raw_drive(work), []),
    ]:
        if not recording.exists():
            print(f"skipped: {recording} is absent", file=sys.stderr)
            continue
        output = work / "benchmark" / name.split(",")[0].replace(" ", "_")
        fpmcl("benchmark", "auto", recording, *arguments, "--output", output)
        benchmark_row(name, output / "benchmark.json")


def ground(work, _seeds):
    for name in ("semantickitti-00-labels", "semantickitti-08-labels", "nuscenes-hdl32"):
        output = settings(f"output_folder={work / 'ground' / name}", "plot_step=0")
        block(fpmcl("ground", require(DATA / name), *output))
        scans = DATA / name / "velodyne"
        if importlib.util.find_spec("pypatchworkpp") and scans.exists():
            block("Patchwork++: " + run(sys.executable, "benches/patchwork.py", scans))
    block(fpmcl("ground", "--simulated"))


def demo(work, _seeds):
    block(fpmcl("demo", "--output", work / "demo"))


def poisson(_work, _seeds):
    for size in ("1000000,9", "1000000,8"):
        block(bench("poisson", FPMCL_POISSON=size, RAYON_NUM_THREADS="2"))


def rays(work, _seeds):
    folder = work / "rays"
    folder.mkdir(parents=True, exist_ok=True)
    block(bench("rendering", FPMCL_BENCH_DIR=str(folder)))
    if importlib.util.find_spec("open3d"):
        block(run(sys.executable, "benches/embree.py", folder))


def basin(work, _seeds):
    block(bench("basin", map_0005(work), DRIVE_0005))


def starts(work, _seeds):
    first, second = kitti_07_drives(work)
    file = map_of(first, work / "kitti_07/map.ply", *given(first))
    block(bench("starts", file, second, FPMCL_STARTS="40"))


# Keys that `thresholds` halves and doubles; of shares it halves and doubles the odds.
KEYS = {
    "tracking_loss": "tolerance_m min_agreement lost_fraction sure_agreement confirming_agreement sure_spread_m".split(),
    "places": "radius_m tolerance_m scale_m likely_weight given_up_weight".split(),
    "proposal.registration": "kernel_m sectors map_error_m".split(),
    "smoothing": "odometry_ahead_m odometry_aside_m odometry_turn_rad robust_sigmas".split(),
    "visibility": "point_margin_m triangle_margin_m crossing_m support_m support_range_m point_votes triangle_votes".split(),
    "loop_closure": "min_similarity min_common_share surface_tolerance drift_share remaining_drift_share".split(),
}


def keys(*blocks):
    return [f"{block}.{key}" for block in blocks for key in KEYS[block]]


def default_of(command, key):
    text = fpmcl("config", command, "--full")
    for part in key.split("."):
        text = text[re.search(rf"^ *{part}:", text, re.MULTILINE).end() :]
    return float(text.split(maxsplit=1)[0])


def scaled(command, key, factor):
    value = default_of(command, key)
    is_share = re.search("agreement|fraction|share|similarity", key)
    return f"{key}={factor * value / (1 + (factor - 1) * value * bool(is_share)):.3g}"


def sensitivity(title, command, varied, names, measured):
    """Prints what is `measured` of each recording with half of each key, its default and twice of it; keys with a blank between
    them change together."""

    def cell(name, values):
        try:
            return measured(name, values)
        except subprocess.CalledProcessError:
            return "error"

    print(f"{title}:\n")
    table("key", "half, default, twice", *names)
    # Each call of the program has one thread.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        default = {name: pool.submit(cell, name, []) for name in names}
        found = []
        for key in varied:
            values = [[scaled(command, part, factor) for part in key.split()] for factor in (0.5, 1, 2)]
            half, twice = ({name: pool.submit(cell, name, value) for name in names} for value in values[::2])
            cells = [[half[name], default[name], twice[name]] for name in names]
            found.append((key, [" ".join(it.split("=")[1] for it in value) for value in values], cells))
        for key, values, cells in found:
            texts = [[it.result() for it in futures] for futures in cells]
            # What does not depend on the key is printed once.
            different = [text if len(set(text)) > 1 else text[:1] for text in texts]
            row(", ".join(f"`{part}`" for part in key.split()), ", ".join(values), *map(" / ".join, different))
    print()


def mirrored(recording, folder):
    """Writes a recording with the other sign of y, which fits no map."""
    for file in (file for file in recording.rglob("*") if file.is_file()):
        data, target = bytearray(file.read_bytes()), folder / file.relative_to(recording)
        if file.suffix in (".bin", ".pcd"):
            head, size = 0, 20 if file.name.endswith(".pcd.bin") else 16
            if file.suffix == ".pcd":
                head = re.search(b"DATA binary\n", data).end()
                size = sum(map(int, re.search(rb"SIZE ([\d ]+)", data)[1].split()))
            # The sign is the highest bit of the last byte of y.
            for last in range(head + 7, len(data), size):
                data[last] ^= 0x80
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    return folder


def block_drive(work, beams):
    """Simulates a drive around a block, with a rolling shutter, that ends where it began."""
    drive = work / f"{beams}-beams/drive_1"
    if not drive.exists():
        sides = "{length_m: 50}, {length_m: 20, turn_deg: 90}, {length_m: 40}, {length_m: 20, turn_deg: 90}, "
        path = f"path=[{2 * sides}{{length_m: 50}}]"
        scanner = [f"scanner.beams={beams}", "scanner.rolling_shutter=true"]
        fpmcl("simulate", *settings(f"output_folder={drive.parent}", path, *scanner))
    return drive


def thresholds(work, _seeds):
    work = work / "thresholds"
    brief = ["--threads", "1", "--force", "--quiet", *settings("output.plots=false")]
    # The 16 beams have the poses of a map of all scans.
    truth = {
        "nuscenes-hdl32": DATA / "nuscenes-hdl32/poses_tum.txt",
        "vlp16-raw": work / "vlp16-raw/all.poses_tum.txt",
        "livox-hku1": DATA / "livox-hku1/optimized_poses.txt",
        "livox-hku2": DATA / "livox-hku2/optimized_poses.txt",
        "os1-thinned": DATA / "os1-thinned/slam_poses.txt",
    }
    sensors = [DRIVE_0005.name, "nuscenes-hdl32", "vlp16-raw", "livox-hku1"]
    for name in {*sensors, *truth}:
        require(DATA / name)
    if not truth["vlp16-raw"].exists():
        fpmcl("build-map", DATA / "vlp16-raw", "--output", work / "vlp16-raw/all.ply", *brief)

    def folder_of(name, values, kind):
        return work / name / kind / ("_".join(values) or "default")

    def map_with(name, values=()):
        file = folder_of(name, values, "map") / "map.ply"
        if not file.exists():
            poses = ["--poses", truth[name]] if name == "vlp16-raw" else []
            even = settings("frame_step=2", f"n_scans={min(160, scans(name))}", *values)
            fpmcl("build-map", DATA / name, *poses, "--output", file, *even, *brief)
        return file

    def localized(name, folder, values=(), file=None, recording=None):
        """Localizes 40 odd scans in the map of the even ones."""
        odd = settings("start_idx=1", "frame_step=2", f"n_scans={min(80, scans(name) - 1)}", *values)
        truths = TRUTH_0005 if name == DRIVE_0005.name else ["--truth", truth[name]]
        chosen = [recording or DATA / name, "--map", file or map_with(name), *truths]
        try:
            fpmcl("localize", *chosen, "--output", folder / "result.npz", "--seed", 1, *odd, *brief)
        except subprocess.CalledProcessError as error:
            # Less than half of the frames are tracking.
            if error.returncode != 3:
                raise
        return judged(folder, "mcl")

    def scans(name):
        return sum(file.suffix in (".bin", ".pcd") for file in (DATA / name).rglob("*"))

    def judged(folder, run_of):
        """Frames that are tracking, frames of them that are wrong, position error and squared error."""
        with open(folder / "frames.csv", newline="") as file:
            frames = [it for it in csv.DictReader(file) if it["state"] == "tracking"]
        wrong = sum(float(it[f"{run_of}_position_error_m"]) > 0.5 for it in frames)
        found = json.loads((folder / "report.json").read_text())[run_of]
        error = "-"
        if found and found["consistency"]:
            error_cm = 100 * found["metrics"]["position_m"]["rmse"]
            error = f"{error_cm:.2f} cm, {found['consistency']['squared_error']:.1f}"
        return f"{len(frames)}, {wrong}, {error}"

    def tracked(name, values):
        return localized(name, folder_of(name, values, "tracked"), values)

    def tracked_mirrored(name, values):
        recording = work / name / "mirrored"
        found = localized(name, folder_of(name, values, "tracked_mirrored"), values, recording=recording)
        return found.split(", ")[1]

    def smoothed(name, values):
        folder = folder_of(name, values, "smoothed")
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(folder_of(name, [], "tracked"), folder)
        fpmcl("refine", folder / "result.npz", "--seed", 1, *settings(*values), *brief)
        return judged(folder, "refined")

    def voted(name, values):
        file = map_with(name, values)
        maps = json.loads(file.with_suffix(".report.json").read_text())["local_maps"]
        gone = sum(it["dynamic_points"] + it["crossed_triangles"] for it in maps)
        return f"{gone}, {localized(name, folder_of(name, values, 'voted'), file=file)}"

    def closed(name, values):
        folder = folder_of(name, values, "closed")
        fpmcl("odometry", with_loops[name], "--output", folder, *settings("adjust=false", *values), *brief)
        poses = truth.get(name, with_loops[name] / "poses.txt")
        rows = [[float(word) for word in line.split()] for line in poses.read_text().splitlines()]
        loops = json.loads((folder / "report.json").read_text())["found_loops"]
        loops = [it for it in loops if it["verdict"] == "accepted"]
        off_m = [it["distance_m"] - math.dist(rows[it["first"]][3::4], rows[it["second"]][3::4]) for it in loops]
        return f"{len(loops)}, {sum(abs(it) > 1 for it in off_m)}"

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(map_with, sensors))
        list(pool.map(lambda name: mirrored(DATA / name, work / name / "mirrored"), sensors))
    errors = "position error, squared error over the covariance"
    found = f"Frames tracking, wrong ones among them, {errors}"
    of_filter = keys("tracking_loss", "places", "proposal.registration")
    sensitivity(f"{found} of `localize`", "localize", of_filter, sensors, tracked)
    shares = [key for key in keys("tracking_loss") if "agreement" in key]
    shares.append(" ".join(shares))
    sensitivity("Wrong frames of the mirrored recording", "localize", shares, sensors, tracked_mirrored)
    sensitivity(f"{found} of `refine`", "refine", keys("smoothing"), sensors, smoothed)
    sensitivity("Points and triangles removed, then as for `localize`", "build-map", keys("visibility"), sensors, voted)
    with_loops = {name: DATA / name for name in ("livox-hku1", "os1-thinned")}
    with_loops["livox-hku2"] = DATA / "livox-hku2/scans"
    with_loops.update({f"{beams} beams, simulated": block_drive(work, beams) for beams in (64, 16)})
    sensitivity("Accepted loops, false ones among them", "odometry", keys("loop_closure"), with_loops, closed)
    timings(work)


def timings(work):
    """Prints how the residuals of the odometry differ with the times of the points, over runs of 16 scans."""
    recordings = [DRIVE_0005, DATA / "semantickitti-00-labels", DATA / "vlp16-raw"]
    recordings += [block_drive(work, beams) for beams in (64, 16)]
    print("Times with the least residual, spread over it, and margin over the spread:\n")
    table("recording", "least", "spread", "margin")
    for recording in recordings:
        found = []
        for first in (0, 16, 32, 44):
            chosen = settings(f"start_idx={first}", "n_scans=16", "loops=false", "adjust=false", "output.plots=false")
            folder = work / "timing"
            command = [PROGRAM, "odometry", recording, "--output", folder, "--force", "-vv", *chosen]
            log = subprocess.run([str(word) for word in command], capture_output=True, text=True).stderr
            least_mm = {}
            for kind, text in re.findall(r"(None|Order|\w*[cC]lockwise).*mean residual ([\d.]+) mm", log):
                least_mm[kind] = min(float(text), least_mm.get(kind, math.inf))
            if len(least_mm) > 1:
                values = sorted(least_mm.values())
                spread = values[-1] - values[0]
                share, margin = spread / values[0], (values[1] - values[0]) / spread
                found.append((min(least_mm, key=least_mm.get), f"{share:.2f}", f"{margin:.2f}"))
        name = recording.name if recording.is_relative_to(DATA) else recording.parent.name
        row(name, *map(", ".join, zip(*found)))


SUBJECTS = [
    drive_0005, kitti_07, odometry, benchmark, ground, demo, poisson, rays, basin, starts, thresholds
]


def processor():
    """The model of the processor, where the system names it."""
    file = pathlib.Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def main():
    names = [subject.__name__ for subject in SUBJECTS]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("subjects", nargs="*", metavar="SUBJECT", help=", ".join(names))
    parser.add_argument("--seeds", default="1,2,3,4,5")
    parser.add_argument("--work", type=pathlib.Path, default=ROOT / "results/measure")
    options = parser.parse_args()
    unknown = set(options.subjects) - set(names)
    if unknown:
        parser.error(f"no such subject: {', '.join(sorted(unknown))}; there are {', '.join(names)}")
    commit = run("git", "describe", "--always", "--dirty", "--abbrev=7").strip()
    print(f"{os.cpu_count()} cores, {processor()}; commit {commit}.")
    for subject in SUBJECTS:
        if options.subjects and subject.__name__ not in options.subjects:
            continue
        print(f"\n## {subject.__name__}\n", flush=True)
        try:
            subject(options.work.resolve(), options.seeds.split(","))
        except Absent as absent:
            print(f"skipped: {absent} is absent", file=sys.stderr)
        except subprocess.CalledProcessError as error:
            print(f"failed: {error}", file=sys.stderr)


if __name__ == "__main__":
    main()
