"""Photographs the live page in a headless browser.

python docs/make_live_picture.py [checkpoint=RUN]

Needs the extras view and dev, chromium and chromedriver.
"""

import shutil
import sys
import time
from pathlib import Path

import torch
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from franka_wm.commands.view import options_of, view
from franka_wm.live.page import Page
from franka_wm.live.session import Session
from franka_wm.live.stage import build

PICTURE = Path(__file__).parent / "images" / "live.png"
FLAGS = (
    "headless=new", "no-sandbox", "disable-gpu", "use-angle=swiftshader", "enable-unsafe-swiftshader", "disable-quic",
    "no-first-run", "disable-background-networking", "disable-component-update", "disable-sync",
    "disable-dev-shm-usage", "window-size=1280,860", "force-device-scale-factor=1",
)  # fmt: skip
GOALS = ((0.35, 0.30, 0.55), (0.55, -0.20, 0.35), (0.42, 0.36, 0.60))


def main() -> None:
    torch.manual_seed(0)
    stage = build(options_of(**view.make_context("view", [*sys.argv[1:], "device=cpu"]).params))
    session = Session(stage.env, stage.policies, policy="planner", seed=4)
    page = Page(session, port=0, title=stage.title)
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "chromium"
    for flag in FLAGS:
        options.add_argument(f"--{flag}")
    browser = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        browser.get(page.address)
        while not page.server.get_clients():
            time.sleep(0.2)
        for goal, steps in zip(GOALS, (120, 120, 6), strict=True):  # the last one is under way
            session.set_goal(goal)
            for _ in range(steps):
                session.step()
        time.sleep(10)  # software rendering takes its time
        close = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
        browser.execute_script(close)  # that there is no GPU is no news here
        page.show(session.frame())
        time.sleep(3)
        PICTURE.parent.mkdir(exist_ok=True)
        browser.save_screenshot(str(PICTURE))
    finally:
        browser.quit()
        page.close()
    print(PICTURE)


if __name__ == "__main__":
    main()
