"""Settings records: frozen, and every field documented with what it is for."""

import importlib
import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "gis_radar"


def records():
    """Yield the settings records of all rooms, those inside others too."""
    for path in sorted(PACKAGE.rglob("*.py")):
        names = re.findall(
            r"^class (\w*Settings)\b", path.read_text(encoding="utf-8"), re.MULTILINE
        )
        room = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        for name in names:
            yield pytest.param(getattr(importlib.import_module(room), name), id=name)


@pytest.mark.parametrize("record", list(records()))
def test_a_settings_record_is_frozen_and_documents_each_field(record):
    assert is_dataclass(record)
    assert record.__dataclass_params__.frozen
    assert all(field.kw_only for field in fields(record))
    section = record.__doc__.partition("----------")[2]
    entries = re.findall(r"^ {4}(\w[\w, ]*?) : .+\n((?: {8}.+\n?)+)", section, re.MULTILINE)
    documented = {name.strip() for names, _ in entries for name in names.split(",")}
    assert documented == {field.name for field in fields(record)}
    assert all(len(text.split()) >= 3 for _, text in entries)
