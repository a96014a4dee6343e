"""The dashboard in a real headless Chromium, against the service as a process with the bundled model."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from dashboard_page import held_still, needs_chromium, running_browser, shot, watched_page
from looking_on import RealService, feed, free_port, real_service, sample_calls, sample_pair
from playwright.sync_api import Browser, Page, Route, expect
from rule_detector import RuleDetector
from service_world import live_server

from viflow_anomaly.detection import ModelInfo
from viflow_anomaly.settings import resolve_settings
from viflow_anomaly_service.api_keys import new_key

pytestmark = needs_chromium
GONE = ("net::ERR_CONNECTION_REFUSED", "net::ERR_INCOMPLETE_CHUNKED_ENCODING", "status of 503", "net::ERR_EMPTY")
REFUSED = ("the server responded with a status of 401", "the server responded with a status of 403")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as running:
        yield running


@pytest.fixture(scope="module")
def service() -> Iterator[RealService]:
    """Has played the sample as stream drone7."""
    with real_service() as running, running.client() as client:
        feed(client)
        yield running


def open_drone7(page: Page) -> None:
    page.get_by_role("button", name=re.compile("drone7")).click()
    expect(page.locator("#stage-title")).to_have_text("drone7")
    held_still(page)


def test_before_the_first_frame_the_page_says_how_to_send_one(browser: Browser, tmp_path: Path) -> None:
    with real_service() as fresh, watched_page(browser, fresh.address) as page:
        expect(page.get_by_role("heading", name="No stream yet")).to_be_visible()
        expect(page.locator("#empty pre")).to_contain_text(f"curl -sS {fresh.address}/streams/")
        expect(page.locator("#connection-text")).to_have_text("Live")
        shot(page, "empty", tmp_path)
        page.locator("#empty-play").click()
        expect(page.get_by_role("button", name=re.compile("sample.*moving", re.DOTALL))).to_be_visible()
        expect(page.locator("#scrub-told")).to_have_text(re.compile("pair 9 of 9"))
        expect(page.locator("#play-sample")).to_have_text("Play the sample")
        expect(page.locator("#announcer")).not_to_be_empty()


def test_an_uploaded_pair_is_drawn_with_its_regions(service: RealService, browser: Browser, tmp_path: Path) -> None:
    with watched_page(browser, service.address) as page:
        page.locator("#open-upload").click()
        for name, (file_name, content, media_type) in sample_pair().items():
            data = content if isinstance(content, bytes) else content.encode()
            page.locator(f"#upload-{name}").set_input_files({"name": file_name, "mimeType": media_type, "buffer": data})
        page.get_by_role("button", name="Look at it").click()
        expect(page.locator("#stage-title")).to_have_text("Inspected pairs")
        expect(page.locator("#picture .roi.motion .line")).to_have_count(1)
        expect(page.get_by_text("guesses of the camera's motion")).to_be_visible()
        expect(page.locator(".bars li")).to_have_count(9)
        expect(page.locator(".bars .score").first).to_have_text(re.compile(r"^\d\.\d{3} \u03c3$"))
        held_still(page)
        page.locator("#show-arrows").check()
        expect(page.locator("#picture .flow-line").nth(100)).to_be_attached()
        shot(page, "uploaded", tmp_path)


def test_what_is_wrong_with_an_upload_is_said_in_the_dialog(service: RealService, browser: Browser) -> None:
    with watched_page(browser, service.address, expected_complaints=("status of 415",)) as page:
        page.locator("#open-upload").click()
        for name in ("source", "target"):
            page.locator(f"#upload-{name}").set_input_files(
                {"name": "a.png", "mimeType": "image/png", "buffer": b"<x>"}
            )
        imu = json.loads(sample_pair()["imu"][1])
        data = json.dumps(imu).encode()
        page.locator("#upload-imu").set_input_files({"name": "i.json", "mimeType": "application/json", "buffer": data})
        page.get_by_role("button", name="Look at it").click()
        expect(page.locator("#upload-dialog [role=alert]")).to_contain_text("expected a PNG or JPEG")
        page.keyboard.press("Escape")
        expect(page.locator("#upload-dialog")).not_to_be_visible()


def test_a_stream_is_followed_as_it_comes(service: RealService, browser: Browser, tmp_path: Path) -> None:
    with watched_page(browser, service.address) as page, service.client() as client:
        expect(page.locator("#connection-text")).to_have_text("Live")
        calls = sample_calls()
        for parts in calls[:4]:
            assert client.post("/streams/followed/frames", files=parts).status_code == 200
        page.get_by_role("button", name=re.compile("followed")).click()
        expect(page.locator("#scrub-told")).to_have_text(re.compile("pair 3 of 3"))
        for number, parts in enumerate(calls[4:], start=4):
            assert client.post("/streams/followed/frames", files=parts).status_code == 200
            expect(page.locator("#scrub-told")).to_have_text(re.compile(f"pair {number} of {number}"))
        expect(page.locator("#picture .tag text").first).to_have_text(re.compile(r"#\d+ 0\.\d\d|#\d+ 1\.00"))
        expect(page.locator("#announcer")).to_have_text(re.compile("new moving thing.* in followed"))
        held_still(page)
        shot(page, "followed", tmp_path)


def test_scrubbing_and_details_by_keyboard_alone(service: RealService, browser: Browser, tmp_path: Path) -> None:
    with watched_page(browser, service.address) as page:
        open_drone7(page)
        slider = page.get_by_role("slider", name="Timeline")
        slider.focus()
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("ArrowLeft")
        expect(slider).to_have_attribute("aria-valuetext", re.compile("pair 7 of 9, 1 moving thing"))
        page.keyboard.press("Home")
        expect(slider).to_have_attribute("aria-valuetext", re.compile("pair 1 of 9"))
        expect(page.get_by_text("guesses of the camera's motion")).to_be_visible()
        page.locator("#roi-1").focus()
        page.keyboard.press("Enter")
        expect(page.get_by_text("Motion: it is wide in both directions")).to_be_visible()
        expect(page.locator("#roi-1")).to_be_focused()
        expect(page.locator("#roi-1")).to_have_attribute("aria-expanded", "true")
        held_still(page)
        shot(page, "detail", tmp_path)
        page.keyboard.press("Escape")
        expect(page.locator("#roi-1")).to_have_attribute("aria-expanded", "false")
        expect(page.locator("#roi-1")).to_be_focused()
        page.get_by_role("tab", name="Regions").focus()
        page.keyboard.press("ArrowRight")
        expect(page.get_by_role("tab", name="Events")).to_be_focused()
        expect(page.get_by_role("tabpanel")).to_contain_text("Things that moved")
        page.get_by_role("button", name="Follow live").click()
        expect(slider).to_have_attribute("aria-valuetext", re.compile("pair 9 of 9"))


def test_tuning_shows_its_effect_and_gives_a_configuration(
    service: RealService, browser: Browser, tmp_path: Path
) -> None:
    with watched_page(browser, service.address) as page:
        open_drone7(page)
        expect(page.locator("#picture .roi.motion .line")).to_have_count(1)
        page.get_by_role("tab", name="Tuner").click()
        slider = page.get_by_role("slider", name="Motion from this score on")
        slider.focus()
        page.keyboard.press("End")
        expect(page.locator("#picture .roi.motion .line")).to_have_count(0)
        expect(page.locator("#picture .ghost")).to_have_count(1)
        expect(page.locator(".effect")).to_contain_text("This pair: 1 → 0")
        expect(page.locator(".effect")).to_contain_text("Last 9 pairs: 9 → 0")
        page.get_by_label("Shape rule").select_option("thickness")
        file = page.get_by_label("Configuration file")
        expect(file).to_contain_text('shape_rule = "thickness"')
        held_still(page)
        shot(page, "tuner", tmp_path)
        copied = tmp_path / "tuned.toml"
        copied.write_text(file.text_content() or "", encoding="utf-8")
        assert tomllib.loads(copied.read_text())["detector"]["regions"] == {
            "motion_score": 1.01,
            "shape_rule": "thickness",
        }
        assert resolve_settings(config_file=copied, environment={}).detector.regions.shape_rule == "thickness"
        page.get_by_role("button", name="As it was").click()
        expect(page.locator("#picture .roi.motion .line")).to_have_count(1)
        expect(page.locator(".configuration")).not_to_be_visible()


def test_the_page_comes_back_when_the_service_does(browser: Browser, tmp_path: Path) -> None:
    port = free_port()
    with real_service(port=port) as first, first.client() as client:
        feed(client, "before", calls=3)
        page_context = watched_page(browser, first.address, expected_complaints=GONE)
        page = page_context.__enter__()
        expect(page.get_by_role("button", name=re.compile("before"))).to_be_visible()
        expect(page.locator("#connection-text")).to_have_text("Live")
    expect(page.locator("#banner")).to_contain_text("The connection to the service is lost")
    expect(page.locator("#connection-text")).to_have_text("Reconnecting")
    shot(page, "reconnecting", tmp_path)
    with real_service(port=port) as second, second.client() as client:
        expect(page.locator("#connection-text")).to_have_text("Live")
        expect(page.locator("#banner")).not_to_be_visible()
        feed(client, "after", calls=3)
        expect(page.get_by_role("button", name=re.compile("after"))).to_be_visible()
        expect(page.get_by_role("button", name=re.compile("before"))).to_have_count(0)
        page_context.__exit__(None, None, None)


def test_with_keys_the_page_asks_for_one_and_keeps_it_for_the_tab(browser: Browser, tmp_path: Path) -> None:
    lines, keys = [], {}
    for scope in ("read", "detect"):
        keys[scope], line = new_key(scope, [scope])  # type: ignore[list-item]
        lines.append(line)
    file = tmp_path / "keys.txt"
    file.write_text("\n".join(lines), encoding="utf-8")
    with real_service(VIFLOW_KEY_FILE=str(file)) as closed:
        with closed.client(**{"X-API-Key": keys["detect"]}) as client:
            feed(client, calls=3)
        with watched_page(browser, closed.address, expected_complaints=REFUSED) as page:
            dialog = page.get_by_role("dialog", name="This service asks for a key")
            expect(dialog).to_be_visible()
            shot(page, "key", tmp_path)
            page.keyboard.press("Escape")
            expect(dialog).to_be_visible()
            page.get_by_label("API key").fill("wrong")
            page.get_by_role("button", name="Use this key").click()
            expect(dialog.get_by_role("alert")).to_have_text("The service does not know this key.")
            page.get_by_label("API key").fill(keys["read"])
            page.keyboard.press("Enter")
            expect(page.get_by_role("button", name=re.compile("drone7"))).to_be_visible()
            held_still(page)
            page.get_by_role("tab", name="Tuner").click()
            page.get_by_role("slider", name="Motion from this score on").press("End")
            expect(page.locator(".effect")).to_contain_text("This key may not do that")
            page.reload()
            expect(page.get_by_role("button", name=re.compile("drone7"))).to_be_visible()
            expect(page.get_by_role("button", name="Change key")).to_be_visible()
            assert keys["read"] not in page.content()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_panel_is_accessible(service: RealService, browser: Browser, tmp_path: Path, scheme: Any) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    with watched_page(browser, service.address, color_scheme=scheme) as page:
        open_drone7(page)
        page.get_by_role("slider", name="Timeline").press("ArrowLeft")
        page.locator("#roi-1").click()
        expect(page.get_by_text("Motion: it is wide in both directions")).to_be_visible()
        faults: dict[str, Any] = {}
        for tab in ("Regions", "Events", "Tuner", "IMU", "Alarms", "Model"):
            page.get_by_role("tab", name=tab).click()
            if tab == "Model":
                page.locator("summary").first.click()
            if tab == "Tuner":
                page.get_by_role("slider", name="Motion from this score on").press("End")
                expect(page.locator(".configuration")).to_be_visible()
            faults[tab] = axe_faults(axe, page)
            shot(page, f"{tab.lower()}-{scheme}", tmp_path)
        page.locator("#open-upload").click()
        faults["upload"] = axe_faults(axe, page)
        assert {place: found for place, found in faults.items() if found} == {}


def axe_faults(axe: Any, page: Page) -> list[str]:
    """What axe-core has against the page, a line each."""
    return [
        f"{fault['id']}: {node['html'][:120]} {node.get('failureSummary', '')[:200]}"
        for fault in axe.run(page).response["violations"]
        for node in fault["nodes"]
    ]


def test_every_control_has_a_name(service: RealService, browser: Browser) -> None:
    with watched_page(browser, service.address) as page:
        open_drone7(page)
        for tab in ("Regions", "Tuner"):
            page.get_by_role("tab", name=tab).click()
            tree = page.locator("body").aria_snapshot()
            unnamed = re.findall(r"^\s*- (?:button|slider|combobox|checkbox|textbox|tab|spinbutton)(?::|$)", tree, re.M)
            assert unnamed == [], tree
        for landmark in ("banner", "main", "contentinfo"):
            expect(page.get_by_role(landmark)).to_have_count(1)  # type: ignore[arg-type]


@pytest.mark.parametrize("width", [360, 768])
def test_narrow_screens_need_no_sideways_scrolling(
    service: RealService, browser: Browser, tmp_path: Path, width: int
) -> None:
    size = {"width": width, "height": 780}
    with watched_page(browser, service.address, viewport=size, has_touch=True) as page:
        open_drone7(page)
        for tab in ("Regions", "Events", "Tuner", "IMU", "Alarms", "Model"):
            page.get_by_role("tab", name=tab).click()
            if tab == "Model":
                page.locator("summary").first.click()
            assert page.evaluate("document.documentElement.scrollWidth") <= width, tab
        page.get_by_role("tab", name="Regions").click()
        shot(page, f"width-{width}", tmp_path, whole=True)


def test_recorded_events_stand_on_the_timeline(browser: Browser, tmp_path: Path) -> None:
    """With a store; the events themselves are answered by the test where the service does not offer them."""
    with real_service(VIFLOW_STORE_URL=str(tmp_path / "detections.db")) as storing, storing.client() as client:
        feed(client)
        pairs = client.get("/streams/drone7/pairs").json()["pairs"][::-1]
        stamps = [pair["detection"]["source_timestamp_ns"] for pair in pairs]
        thing = {"thing_id": "a-1", "stream_id": "drone7", "track_id": 1, "started_at_ns": stamps[0], "score": 0.9}
        end = {**thing, "event_id": "2", "kind": "end", "timestamp_ns": stamps[6], "reason": "left", "top_score": 0.97}
        start = {**thing, "event_id": "1", "kind": "start", "timestamp_ns": stamps[0], "reason": None}
        with watched_page(browser, storing.address) as page:
            page.get_by_role("tab", name="Events").click()
            expect(page.get_by_role("tabpanel")).to_contain_text(re.compile("Stored detections|Recorded events"))
            described = client.get("/openapi.json").json()
            described["paths"]["/events"] = {}
            page.route("**/openapi.json", lambda route: route.fulfill(json=described))
            page.route("**/events?stream=drone7*", lambda route: route.fulfill(json={"events": [end, start]}))
            page.reload()
            page.get_by_role("tab", name="Events").click()
            item = page.get_by_role("button", name=re.compile("Track 1 0.30 s, left 0.97"))
            item.click()
            expect(page.locator("#scrub-told")).to_have_text(re.compile("pair 7 of 9"))
            expect(page.locator(".thing.began")).to_have_count(1)
            expect(page.locator(".thing.ended")).to_have_count(1)
            shot(page, "events", tmp_path)
            assert uncut(page, ".thing.began")


def uncut(page: Page, selector: str) -> bool:
    """Whether it stands clear of the timeline's left edge, which is round."""
    # In one go: the timeline is drawn anew with every answer.
    left = "one => document.querySelector(one).getBoundingClientRect().left"
    difference = page.evaluate(f"one => ({left})(one) - ({left})('.timeline-picture')", selector)
    return bool(difference >= 3)


def test_a_rate_of_alarms_needs_a_minute_of_footage(service: RealService, browser: Browser) -> None:
    def longer(route: Route) -> None:
        told = route.fetch().json()
        for stream in told["streams"]:
            stream.update(footage_s=60.0, alarms_per_hour=540.0)
        route.fulfill(json=told)

    with watched_page(browser, service.address) as page:
        open_drone7(page)
        page.get_by_role("tab", name="Alarms").click()
        item = page.locator(".rate").filter(has_text="drone7")
        expect(item).to_contain_text("less than 1 minute of footage")
        expect(item.locator(".score")).to_have_text("\u2013")
        expect(item.locator(".rate-bar")).to_have_count(0)
        page.route("**/live", longer)
        page.reload()
        page.get_by_role("tab", name="Alarms").click()
        expect(item.locator(".score")).to_have_text("540/h")
        expect(item.locator(".rate-bar")).to_have_count(1)


def test_what_the_service_says_is_never_taken_for_markup(browser: Browser) -> None:
    class Hostile(RuleDetector):
        def __init__(self, **options: Any) -> None:
            super().__init__(**options)
            self.model_info = ModelInfo(name="<img src=x onerror=alert(1)>", version="1", sha256="ab" * 32)

    with live_server(lambda settings: Hostile()) as server:
        feed(server.client, calls=3)
        address = f"http://127.0.0.1:{server.port}"
        with watched_page(browser, address, expected_complaints=("status of 501",)) as page:
            expect(page.locator("#model-line")).to_have_text("<img src=x onerror=alert(1)> 1")
            expect(page.locator("#map .frame-note")).to_contain_text("maps_unavailable")
            assert page.locator("img[src=x]").count() == 0
