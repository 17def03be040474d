"""The pose that a city's run has found counts as long as what it was found from."""

import pytest

from gis_radar.city import tasks
from gis_radar.site import RunState


@pytest.fixture
def city(tmp_path, monkeypatch):
    """Give a function that runs a site, and returns its sensor as its pose was looked for."""
    for name in ("map.osm", "scan.laz", "R.1_a.parquet"):
        (tmp_path / name).write_text(name, encoding="utf-8")
    (tmp_path / "SITE.toml").write_text(
        'title = "x"\n[map]\nfile = "map.osm"\n[scan]\nfiles = ["scan.laz"]\n'
        '[[sensor]]\nname = "R.1"\nrecordings = ["R.1_*.parquet"]\n'
        "guess = [690356.0, 5336183.0]\nheading = 20.0\n",
        encoding="utf-8",
    )
    task = tasks.SiteTask(root=tmp_path / "root", name="one", file=tmp_path / "SITE.toml")
    found = task.results / "sensors" / "R.1" / "pose.json"
    found.parent.mkdir(parents=True)
    found.write_text("{}", encoding="utf-8")
    seen, prepared = {}, []
    monkeypatch.setattr(tasks, "prepare_site", lambda site, *_, **__: prepared.append(site) or [])
    monkeypatch.setattr(tasks, "registered_recordings", lambda _: seen)

    def register(site, _):
        paths = [path for sensor in site.sensor for path in sensor.recordings]
        state = RunState(tmp_path / "state.json", tmp_path)
        seen.update({path.as_posix(): state.hash_of(path) for path in paths})

    monkeypatch.setattr(tasks, "register_checked", register)

    def run():
        tasks.add_recordings(task)
        return prepared[-1].sensor[0]

    return run


@pytest.mark.parametrize(
    ("file", "before", "after"),
    [
        ("SITE.toml", "690356.0", "690366.0"),
        ("SITE.toml", "20.0", "70.0"),
        ("map.osm", "map", "another map"),
    ],
)
def test_a_pose_is_found_again_where_guess_heading_or_map_differ(
    city, tmp_path, file, before, after
):
    assert city().pose is None
    kept = tmp_path / "root" / "poses" / "one" / "R.1.json"
    assert (city().pose, city().guess) == (kept, None)
    path = tmp_path / file
    path.write_text(path.read_text(encoding="utf-8").replace(before, after), encoding="utf-8")
    assert city().pose == kept  # nothing has come that needs another
    (tmp_path / "R.1_b.parquet").touch()
    again = city()
    assert again.pose is None
    assert again.recordings == (tmp_path / "R.1_b.parquet",)  # the dataset's keep their pose
    assert city().pose == kept
