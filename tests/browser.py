"""A real Chromium, headless, for tests of pages."""

import os
import shutil

import pytest
from selenium import webdriver

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--window-size=1280,900",
)  # fmt: skip
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def start_chromium(folder, *, draws_maps=False):
    """Start Chromium; skip where there is none, fail where there must be one."""
    program, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver is None:
        why = "no chromium and chromedriver here: see tools/get_chromium.sh"
        if os.environ.get("GIS_RADAR_CHROMIUM") == "required":
            pytest.fail(why)
        pytest.skip(why)
    options = webdriver.ChromeOptions()
    options.binary_location = program
    pictures = SOFTWARE_GL if draws_maps else ("--disable-gpu",)
    for flag in (*FLAGS, *pictures, f"--user-data-dir={folder}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    return webdriver.Chrome(options, webdriver.ChromeService(driver))


def wide(browser, width):
    """Give the window a width, in pixels."""
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False},
    )
