"""Errors of poses found by traffic alone, and by traffic and the scan.

    python bench/scan_poses.py --scene town-991,tee-932
    python bench/scan_poses.py --scene bends    bends, where traffic alone does not fix the place

A line a sensor of the scenes of bench/vehicles; guesses are up to 10 m off, without a heading.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path += [str(ROOT / "bench" / "vehicles")]

from scenes import SceneFiles, scene  # noqa: E402

import gis_radar as gr  # noqa: E402
from gis_radar.base import Floats, NoAnswerError  # noqa: E402

NAMES = ("easting", "northing", "height", "roll", "pitch", "yaw")
SCENES = (
    "town-981", "tee-982", "gridlock-983", "arterial-984", "roundabout-985", "town-941",
    "arterial-943", "town-951", "gridlock-956",
)  # fmt: skip
BENDS = tuple(f"bend-{seed}" for seed in (*range(8301, 8307), *range(8401, 8405)))
GUESS_M = 10.0


def main() -> None:
    """Find the poses of all sensors twice; print a line a sensor, and means."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default=",".join(SCENES))
    rows = []
    named = parser.parse_args().scene
    for name in BENDS if named == "bends" else named.split(","):
        site = scene(name)
        for recording, truth in zip(site.recordings, site.poses, strict=True):
            both = [_errors(site, recording, truth, scans) for scans in ((), (site.scan,))]
            print(name, truth.sensor, *map(_line, both), sep=" | ", flush=True)
            found = [each for each in both if each is not None]
            if len(found) == len(both):
                rows.append(found)
    for k, kind in enumerate(("traffic", "traffic and scan")):
        error, sigma = (np.array([row[k][i] for row in rows]) for i in (0, 1))
        place = np.hypot(error[:, 0], error[:, 1])
        inside = (np.abs(error) < 2.0 * sigma).mean(axis=0)
        print(
            f"{kind}: {len(rows)} sensors, 2D {place.mean():.3f} m (median "
            f"{np.median(place):.3f}, largest {place.max():.2f}), yaw "
            f"{np.abs(error[:, 5]).mean():.3f} deg, within 2 sigma {inside.round(2).tolist()}"
        )


def _errors(
    site: SceneFiles, recording: Path, truth: gr.Pose, scans: tuple[Path, ...]
) -> tuple[Floats, Floats] | None:
    """Return errors and sigmas, metres and degrees; None where the answer is refused."""
    rng = np.random.default_rng([7, *truth.sensor.encode(), *site.name.encode()])
    away, angle = GUESS_M * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
    guess = truth.position[:2] + away * np.array([np.cos(angle), np.sin(angle)])
    try:
        road = _road(site)
        found = gr.localize(recording, site.map, road, guess=guess.tolist(), scans=scans).pose
    except NoAnswerError:
        return None
    error = np.array([getattr(found, name) - getattr(truth, name) for name in NAMES])
    error[3:] = (error[3:] + 180.0) % 360.0 - 180.0
    return error, np.array([found.evidence["sigma"][name] for name in NAMES])


def _road(site: SceneFiles) -> Path:
    """Return the road of a scene, masked once."""
    road: Path = site.kept / "road.laz"
    if not road.exists():
        gr.mask_road([site.scan], site.map).write(road)
    return road


def _line(found: tuple[Floats, Floats] | None) -> str:
    """Return the error on the plane and of the yaw (degrees) as text."""
    if found is None:
        return "refused"
    error = found[0]
    return f"{np.hypot(error[0], error[1]):.2f} m, yaw {error[5]:+.2f}"


if __name__ == "__main__":
    main()
