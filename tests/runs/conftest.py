"""A small site, a run of it, and copies of both to be changed."""

from __future__ import annotations

import shutil

import pytest
from site_runs import in_a_thread, unchecked
from small_site import write_site

import gis_radar as gr
from gis_radar.site import run as product


@pytest.fixture(scope="module")
def small(once):
    """A small site, the folder of an unbroken run of it, and the true poses."""

    def unbroken(folder):
        (folder / "site").mkdir()
        path, poses = write_site(folder / "site")
        with pytest.MonkeyPatch.context() as here, unchecked():
            here.setattr(product, "process_pool", in_a_thread)
            done = gr.run_site(path, folder / "out")
        assert done.failure is None
        return path, folder / "out", poses

    return once("small", unbroken)


@pytest.fixture
def copied(small, tmp_path, in_this_process, all_fit):
    """A copy of the site and of its results, to be changed."""
    path, out, _ = small
    shutil.copytree(path.parent, tmp_path / "site")
    shutil.copytree(out, tmp_path / "out")
    return tmp_path / "site" / "SITE.toml", tmp_path / "out"
