"""The live page in a real browser: it loads, shows the arm, and a goal dragged with the mouse moves it."""

from __future__ import annotations

import io
import shutil
import time
import warnings
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("viser", reason="needs the extra view")
webdriver = pytest.importorskip("selenium.webdriver", reason="needs selenium")

from selenium.common.exceptions import TimeoutException  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.action_chains import ActionChains  # noqa: E402
from selenium.webdriver.common.actions.action_builder import ActionBuilder  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402

from franka_wm.live.page import Page  # noqa: E402
from franka_wm.live.viser_scene import GOAL  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
# Software rendering, and no service of the browser's own.
FLAGS = (
    "headless=new", "no-sandbox", "disable-gpu", "use-angle=swiftshader", "enable-unsafe-swiftshader", "disable-quic",
    "no-first-run", "disable-background-networking", "disable-component-update", "disable-sync",
    "disable-dev-shm-usage", "window-size=1000,700", "force-device-scale-factor=1",
)  # fmt: skip

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None or DRIVER is None, reason="needs chromium and chromedriver"),
]

START = (0.45, 0.05, 0.45)


@pytest.fixture(scope="module")
def page(make_session) -> Iterator[Page]:
    session = make_session(policy="ik", keep_goal=True)
    session.set_goal(START)
    for _ in range(40):
        session.step()
    page = Page(session, port=0)
    yield page
    page.close()


def started(address: str):
    """A browser that has loaded the page."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in FLAGS:
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(DRIVER))
    browser.set_page_load_timeout(60)
    try:
        browser.get(address)
    except BaseException:
        browser.quit()
        raise
    return browser


@pytest.fixture(scope="module")
def browser(page: Page) -> Iterator:
    """The one browser of these tests: a second one that draws in software can starve two cores."""
    try:
        browser = started(page.address)
    except TimeoutException as error:
        warnings.warn(f"Chromium did not load the page and is started again: {error.msg}", stacklevel=1)
        browser = started(page.address)
    wait(lambda: browser.find_elements(By.TAG_NAME, "canvas"), "no canvas")
    wait(lambda: page.server.get_clients(), "the page has not connected")
    wait(lambda: drawn(picture(browser)), "the arm was not drawn")
    yield browser
    browser.quit()


def wait(condition: Callable[[], object], complaint: str, seconds: float = 45.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, complaint
        time.sleep(0.25)


def picture(browser) -> np.ndarray:
    """(H, W, 3) of the scene; the controls' part of the window is cut off."""
    shot = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
    return np.asarray(shot)[:, : shot.width - 340].astype(np.int32)


def drawn(shot: np.ndarray) -> bool:
    """Whether white shells, dark joints and the goal's or success's colour are all there."""
    dark = (shot.max(-1) < 60).mean()
    spread = shot.std((0, 1)).min()
    return bool(dark > 0.003 and spread > 10)


def on_screen(page: Page, point: np.ndarray) -> tuple[int, int]:
    """Where a world point is in the window [px] of the page's newest client."""
    camera = page.server.get_clients()[max(page.server.get_clients())].camera
    w, x, y, z = camera.wxyz
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    right, down, ahead = rotation.T @ (np.asarray(point) - camera.position)
    focal = 0.5 * camera.image_height / np.tan(0.5 * camera.fov)
    return (
        round(0.5 * camera.image_width + focal * right / ahead),
        round(0.5 * camera.image_height + focal * down / ahead),
    )


def test_the_page_shows_the_arm_and_its_controls(page: Page, browser) -> None:
    for name in ("/arm/base/000", "/arm/link7/012", "/goal/ball", "/ground"):
        assert page.server.scene.get_handle_by_name(name) is not None
    assert page.scene._halo.visible, "how near is a success"
    text = browser.find_element(By.TAG_NAME, "body").text
    for word in ("Play", "New episode", "distance to the goal", "reward", "Planner", "horizon"):
        assert word in text
    errors = [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]
    assert not errors


def test_the_picture_changes_when_the_arm_moves_and_not_while_it_rests(page: Page, browser) -> None:
    session = page.session
    session.pause()
    time.sleep(1.0)
    before, again = picture(browser), picture(browser)
    assert np.abs(again - before).max() < 40, "nothing moves while paused"
    session.set_goal((0.35, -0.35, 0.6))
    for _ in range(40):
        session.step()
    wait(
        lambda: (np.abs(picture(browser) - before).max(-1) > 60).mean() > 0.01,
        "the picture does not follow the arm",
    )
    session.set_goal(START)
    for _ in range(40):
        session.step()


def test_a_goal_dragged_with_the_mouse_moves_the_arm(page: Page, browser) -> None:
    session = page.session
    tool = session.frame().tool
    np.testing.assert_allclose(tool, START, atol=0.02)
    session.play()
    grab = on_screen(page, np.add(START, (0.0, 0.0, 0.10)))  # the upright arrow
    mouse = ActionBuilder(browser, duration=60)
    mouse.pointer_action.move_to_location(*grab).pointer_down()
    for k in range(1, 9):
        mouse.pointer_action.move_to_location(grab[0], grab[1] - 12 * k)
    mouse.pointer_action.pointer_up()
    mouse.perform()
    wait(lambda: session.goal[2] > START[2] + 0.05, "the goal was not dragged")
    assert np.abs(session.goal[:2] - START[:2]).max() < 0.02, "the arrow moves it upright only"
    wait(lambda: session.frame().tool[2] > START[2] + 0.05, "the arm does not follow")
    wait(lambda: session.frame().distance < 0.02, "the arm does not arrive")
    assert session.error is None
    session.pause()


def test_buttons_and_sliders_reach_the_session(page: Page, browser) -> None:
    session = page.session
    session.pause()
    button = next(b for b in browser.find_elements(By.TAG_NAME, "button") if b.text in ("Play", "Pause"))
    ActionChains(browser).click(button).perform()
    wait(lambda: session.playing, "Play was not heard")
    wait(lambda: button.text == "Pause", "the button does not say what it does now")
    ActionChains(browser).click(button).perform()
    wait(lambda: not session.playing, "Pause was not heard")
    episode = session.frame().episode
    again = next(b for b in browser.find_elements(By.TAG_NAME, "button") if b.text == "New episode")
    ActionChains(browser).click(again).perform()
    wait(lambda: session.frame().episode == episode + 1, "New episode was not heard")
    before = session.planner
    inputs = [i for i in browser.find_elements(By.CSS_SELECTOR, "input") if i.is_displayed()]
    horizon = next(i for i in inputs if i.get_attribute("value") == str(before.horizon))
    browser.execute_script("arguments[0].scrollIntoView()", horizon)
    keys = ActionChains(browser).click(horizon).key_down(Keys.CONTROL).send_keys("a").key_up(Keys.CONTROL)
    keys.send_keys("4", Keys.ENTER).perform()
    wait(lambda: session.planner is not before, "the slider was not heard")
    assert session.planner.horizon == 4


def test_the_goal_has_its_colour_until_it_is_reached(page: Page, browser) -> None:
    session = page.session
    session.pause()
    session.set_policy("noop")
    session.set_goal((0.5, 0.3, 0.3))
    session.step()
    x, y = on_screen(page, session.goal)

    def hue() -> np.ndarray:
        return picture(browser)[y - 3 : y + 4, x - 3 : x + 4].reshape(-1, 3).mean(0)

    assert GOAL[0] > GOAL[1] > GOAL[2]
    wait(lambda: hue()[0] > hue()[2] + 40, f"the ball at {x}, {y} is not orange: {hue()}")


@pytest.fixture(params=[(360, 640), (400, 860)])
def size(request, browser) -> Iterator[tuple[int, int]]:
    """A phone's width and height [px], which the browser has meanwhile."""
    width, height = request.param
    metrics = {"width": width, "height": height, "deviceScaleFactor": 2.0, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    yield width, height
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})


def test_on_a_phone_the_arm_is_above_the_controls(page: Page, browser, size) -> None:
    """Links and goal of every pose within reach: stretched out to each side, up, and folded."""
    page.session.pause()
    before = max(page.server.get_clients())

    def phone():
        """None until it has connected; a slow one may connect twice."""
        clients = page.server.get_clients()
        return clients[max(clients)] if max(clients, default=before) > before else None

    browser.refresh()
    wait(phone, "the phone has not connected")
    handle = "//*[text()='franka_wm']"
    wait(lambda: browser.find_elements(By.XPATH, handle), "no controls")
    top = browser.find_element(By.XPATH, handle).rect["y"]
    assert 0.35 * size[1] < top < 0.6 * size[1], "the controls open over the lower part"
    wait(lambda: (client := phone()) and client.camera.look_at[2] < 0, "the camera was not moved")
    client = phone()
    ratio = client.camera.image_width / size[0]
    for point in [(0.75, 0, 0.3), (0, 0.75, 0.3), (0, -0.75, 0.3), (0, 0, 1.15), (0, 0, 0), (-0.15, 0, 0)]:
        x, y = (value / ratio for value in on_screen(page, np.array(point)))
        assert 0 < x < size[0] and 0 < y < top, (
            f"{point} m is at {x:.0f}, {y:.0f} px; controls from {top:.0f}"
        )
