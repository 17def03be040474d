"""Fuzzing, for some seconds: what was found once, and bytes by a fixed seed for every target.

``make fuzz`` searches for hours, led by coverage; what it finds becomes a line in FOUND.
"""

import io
import logging
import random
import re
import shutil
import sqlite3
from contextlib import closing

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from faults.inputs import part_of

from fuzz import edits
from fuzz.targets import FIRST_CLOUD, TARGETS, Bench

RUNS = 8  # a target


def column(name, value, kind):
    """Return a change of a column of a Parquet file: one value throughout."""

    def change(data, path):
        content = pq.read_table(io.BytesIO(data))
        number = content.schema.get_field_index(name)
        values = pa.array([value] * len(content), kind)
        pq.write_table(content.set_column(number, name, values), path)

    return change


def metadata_of(text):
    def change(data, path):
        content = pq.read_table(io.BytesIO(data))
        pq.write_table(content.replace_schema_metadata({b"gis_radar": text}), path)

    return change


def instead(old, new):
    def change(data, path):
        assert old in data
        path.write_bytes(data.replace(old, new))

    return change


def changed_number(text):
    """Put a text in the place of a corner's northing."""
    return lambda data, path: path.write_bytes(
        re.sub(
            rb", (\S+) \S+?,", lambda found: b", " + found[1] + b" " + text + b",", data, count=1
        )
    )


def statement(text):
    def change(data, path):
        path.write_bytes(data)
        with closing(sqlite3.connect(path)) as base, base:
            for name in edits.OF_GDAL:
                base.create_function(name, 1, lambda _: 0)
            base.execute(text)

    return change


def zeroed(at):
    """Return what a loss of power makes of the pages from a place on."""
    return lambda data, path: path.write_bytes(data[:at] + bytes(len(data) - at))


def infinite_azimuth(data, path):
    path.write_bytes(data[:101] + b"\x7f\x80\0\0" + data[105:])


def half_moved(data, path):
    """Move every other node of a map by three degrees."""
    first, *nodes = data.split(b'lon="11')
    parts = [(b'lon="14' if k % 2 else b'lon="11') + node for k, node in enumerate(nodes)]
    path.write_bytes(first + b"".join(parts))


LISTS = pa.list_(pa.int64())
# What the fuzzer found once: the target, its file and what is changed in it.
FOUND = [
    ("roads csv", "roads.csv", lambda _, path: path.write_bytes(b"")),
    ("roads csv", "roads.csv", changed_number(b"nan")),
    ("roads csv", "roads.csv", changed_number(b"9" * 5000)),
    ("ars548", "list2.bin", infinite_azimuth),
    ("csv table", "table.csv", instead(b"6.0", b"6e300")),
    ("pose", "R1.json", instead(b"EPSG:25832", b"\\ud800")),
    ("dataset", part_of("frames"), metadata_of(b"\xff")),
    ("dataset", part_of("frames"), column("sensor", [], LISTS)),
    ("dataset", part_of("frames"), column("sensor", b"R1", pa.binary())),
    ("dataset products", part_of("frames"), column("first_step", -(1 << 60), pa.int64())),
    ("dataset products", part_of("frames"), column("last_step", 1 << 60, pa.int64())),
    ("dataset", part_of("tracks"), column("step", "a", pa.string())),
    ("dataset", part_of("visible"), metadata_of(b"\xff")),
    *(
        ("dataset documents", "dataset/dataset.json", instead(b'"fingerprint": "', each))
        for each in (b'"fingerprint": "a\\nb', b'"fingerprint": "\\ud800')
    ),
    ("roads csv", "roads.csv", changed_number(b"1e300")),
    ("site", "SITE.toml", instead(b"map.osm", b"9" * 400)),
    ("site", "SITE.toml", instead(b"map.osm", b"~nobody-has-this-name/map.osm")),
    (
        "mcap",
        "mcap/mcap.mcap",
        instead(b"MSG: sensor_msgs/PointField", b"MSG: 3ensor_msgs/PointField"),
    ),
    (
        "heat map",
        "heatmap/heatmap.gpkg",
        statement("UPDATE gpkg_contents SET data_type = 'attributes'"),
    ),
    *(
        ("live buffer", "live/buffer", statement(text))
        for text in (
            "ALTER TABLE messages RENAME COLUMN number TO other",
            "UPDATE notes SET value = '/'",
            "UPDATE notes SET value = X'FF'",
            "UPDATE notes SET value = CAST(X'FF' AS TEXT)",
        )
    ),
    ("live records", "live/pose", instead(b'"event":""', b'"event":"\\ud800"')),
    ("osm", "map.osm", half_moved),
    ("rosbag2 metadata", "bag/metadata.yaml", instead(b"nanoseconds: ", b"nanoseconds: &a ")),
    ("pcd", FIRST_CLOUD, instead(b"SIZE 4", b"SIZE ,,,1")),
    ("live buffer bytes", "live/buffer", zeroed(4096)),
    ("live buffer bytes", "live/buffer", lambda data, path: path.write_bytes(data[:5000])),
]


@pytest.fixture(scope="module")
def inputs(sound_inputs, tmp_path_factory):
    return shutil.copytree(sound_inputs, tmp_path_factory.mktemp("fuzz") / "inputs")


@pytest.fixture(autouse=True)
def quiet():
    """Remarks of what is read are of no interest here."""
    logging.disable()
    yield
    logging.disable(logging.NOTSET)


def there(name):
    """Return a target; skip where what it reads with is not installed."""
    target = TARGETS[name]
    return pytest.importorskip(target.needs) and target if target.needs else target


def changed(seed, chance):
    """Return bytes with some of them changed, doubled or left out."""
    data = bytearray(seed or chance.randbytes(24))
    for _ in range(chance.randint(1, 4)):
        at, size = chance.randrange(len(data) or 1), chance.choice((1, 1, 4, 64))
        what = chance.randrange(3)
        data[at : at + size] = (chance.randbytes(size), b"", data[at : at + size] * 2)[what]
    return bytes(data)


@pytest.mark.parametrize("name", TARGETS)
def test_bytes_at_random(inputs, name):
    chance, target = random.Random(7), there(name)  # noqa: S311 - not for secrets
    seeds, bench = target.seeds(inputs), Bench(target, inputs)
    found = [bench.run(changed(chance.choice(seeds), chance)) for _ in range(RUNS)]
    bench.restore()
    for finding in filter(None, found):
        pytest.fail(f"{finding.name}: {finding.text}")
    target.read(inputs)


@pytest.mark.parametrize(("name", "path", "change"), FOUND)
def test_what_was_found(inputs, name, path, change):
    target, sound = there(name), (inputs / path).read_bytes()
    change(sound, inputs / path)
    finding = Bench(target, inputs).read()
    (inputs / path).write_bytes(sound)
    assert finding is None, finding.text
