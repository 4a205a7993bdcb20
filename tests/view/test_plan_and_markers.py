"""A plan under the map, aligned by two points; markers set on the page and on phones."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect
from stage import Stage, wait_for

from relpos.live.board import Board, BoardError
from relpos.live.mission import Mission
from relpos.view.plans import PlanImages


def png(width: int, height: int) -> bytes:
    """A plan: white rooms between black walls."""
    rows = b"".join(
        b"\x00" + bytes(0 if x % 100 < 6 or y % 100 < 6 else 255 for x in range(width))
        for y in range(height)
    )

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def click(page: Page, x: float, y: float) -> None:
    box = page.locator("#map").bounding_box()
    assert box
    page.mouse.click(box["x"] + x, box["y"] + y)


def test_a_plan_is_laid_under_the_map_and_aligned_by_two_points_with_the_residual_of_a_third(
    visit: Any, stage: Stage, tmp_path: Path
) -> None:
    page = visit(viewport={"width": 1366, "height": 768})
    other = visit()
    expect(page.locator("#people li")).to_have_count(6)
    page.locator("#layers summary").click()
    expect(page.locator("#plan-align")).to_be_disabled()
    (tmp_path / "plan.png").write_bytes(png(600, 400))
    page.locator("#plan-file").set_input_files(tmp_path / "plan.png")
    expect(page.locator("#plan-align")).to_be_enabled()
    expect(other.locator("#plan-align")).to_be_enabled()
    page.wait_for_function("document.querySelector('#map') !== null")
    page.locator("#plan-align").click()
    status = page.locator("#ground-status")
    # Each pair of clicks at one place: the plan stays where it is, now by points.
    for count, (x, y) in enumerate(((400, 300), (700, 500), (500, 500)), 1):
        expect(status).to_contain_text(f"{count}")
        click(page, x, y)
        expect(status).to_contain_text("is on the map")
        click(page, x, y + (20 if count == 3 else 0))
    expect(status).to_contain_text("The 3rd point misses by")
    wait_for(lambda: stage.board.plan is not None and len(stage.board.plan.points) == 3)
    page.locator("#layers summary").click()
    page.locator("#plan-remove").click()
    expect(other.locator("#plan-align")).to_be_disabled()


def upload(page: Page, path: Path, data: bytes) -> None:
    path.write_bytes(data)
    page.locator("#plan-file").set_input_files(path)


def test_points_of_one_plan_never_align_another(visit: Any, stage: Stage, tmp_path: Path) -> None:
    page, other = visit(viewport={"width": 1366, "height": 768}), visit()
    page.locator("#layers summary").click()
    upload(page, tmp_path / "one.png", png(600, 400))
    expect(page.locator("#plan-align")).to_be_enabled()
    page.locator("#plan-align").click()
    status = page.locator("#ground-status")
    for x, y in ((400, 300), (400, 300), (700, 500)):
        click(page, x, y)
    expect(status).to_contain_text("2nd point is on the map")
    assert stage.board.plan is not None
    before = stage.board.plan.image
    upload(other, tmp_path / "two.png", png(300, 200))
    wait_for(lambda: stage.board.plan is not None and stage.board.plan.image != before)
    page.wait_for_timeout(500)
    click(page, 700, 500)
    expect(status).to_be_hidden()
    page.wait_for_timeout(500)
    assert stage.board.plan.points == []
    # Nor on its way to the session.
    late = {"action": "align", "image": before, "points": [[0, 0, 1, 1], [9, 9, 5, 5]]}
    with pytest.raises(BoardError, match="there is no plan"):
        stage.board.apply({"kind": "plan", "by": "", "unix_s": 1.0, **late})


def test_the_plan_is_the_last_one_also_where_the_one_before_was_slower(
    visit: Any, stage: Stage, tmp_path: Path
) -> None:
    page, other = visit(viewport={"width": 1366, "height": 768}), visit()
    late: list[Any] = []
    page.route("**/api/image/*", lambda r: r.continue_() if late else late.append(r))
    # Black and white: where the plan lies the map is grey, or as bright as it was.
    with page.expect_request("**/api/image/*"):
        upload(other, tmp_path / "black.png", png(6, 6))
    upload(other, tmp_path / "large.png", png(700, 700))
    expect(page.locator("#plan-align")).to_be_enabled()
    page.wait_for_timeout(300)
    stage.frozen = True
    page.wait_for_timeout(300)
    dark = """() => { const c = document.getElementById("map");
        const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data; let n = 0;
        for (let k = 0; k < d.length; k += 4) n += d[k] + d[k + 1] + d[k + 2] < 540; return n; }"""
    few = page.evaluate(dark)
    late[0].fulfill(body=png(6, 6), content_type="image/png")
    page.wait_for_timeout(700)
    assert page.evaluate(dark) < 1.5 * few


def test_markers_are_set_by_key_and_from_a_phone_and_removed(visit: Any, stage: Stage) -> None:
    page = visit(viewport={"width": 1366, "height": 768})
    phone = visit("/phone", viewport={"width": 390, "height": 844})
    phone.locator("[data-wearer='2']").click()
    phone.get_by_role("button", name="This is me").click()
    phone.locator("#marker-sign").select_option("found")
    phone.locator("#marker-place").click()
    expect(phone.locator("#last")).to_have_text("Marked: found")
    page.locator("#layers summary").click()
    expect(page.locator("#markers")).to_contain_text("found, Ben")
    page.locator("#marker-sign").select_option("hydrant")
    page.locator("#marker-place").click()
    page.keyboard.press("Enter")
    page.locator("#layers summary").click()
    expect(page.locator("#markers li")).to_have_count(2)
    expect(page.locator("#map-words")).to_contain_text("hydrant")
    page.get_by_role("button", name="Remove: hydrant").click()
    expect(page.locator("#markers li")).to_have_count(1)
    assert [marker.sign for marker in stage.board.markers.values()] == ["found"]


def event(kind: str, **body: Any) -> dict[str, Any]:
    return {"kind": kind, "unix_s": 5.0, "by": "Anna", **body}


def test_the_board_keeps_markers_and_the_plan_and_refuses_what_makes_no_sense() -> None:
    board = Board()
    board.apply(event("marker", action="set", id="a", sign="exit", x_m=1, y_m=2.5))
    board.apply(event("plan", action="set", image="x.png"))
    board.apply(event("plan", action="align", points=[[0, 0, 1, 1], [9, 9, 5, 5]]))
    assert (board.markers["a"].sign, board.markers["a"].y_m) == ("exit", 2.5)
    assert board.plan is not None
    assert len(board.plan.points) == 2
    for kind, body in (
        ("marker", {"action": "set", "id": "b", "sign": "dragon", "x_m": 1, "y_m": 1}),
        ("marker", {"action": "set", "id": "b", "sign": "exit", "x_m": 1e9, "y_m": 1}),
        ("marker", {"action": "set", "id": "b", "sign": "exit"}),
        ("marker", {"action": "remove", "id": "c"}),
        ("plan", {"action": "align", "points": [[1, 2, 3]]}),
        ("plan", {"action": "align", "points": "all"}),
    ):
        with pytest.raises(BoardError):
            board.apply(event(kind, **body))
    assert list(board.markers) == ["a"]


@pytest.mark.parametrize("image", ["../x.png", "x.svg", "x" * 41 + ".png", 5, "\ud800.png"])
def test_a_plan_is_an_image_that_was_uploaded(image: object) -> None:
    board = Board()
    with pytest.raises(BoardError):
        board.apply({"kind": "plan", "action": "set", "image": image})
    assert board.plan is None


def test_a_call_is_of_nodes_and_of_each_once() -> None:
    board, event = Board(), {"action": "start", "by": "", "unix_s": 1.0}
    board.apply({"kind": "rollcall", **event, "nodes": [3, 1, 3, True, 0, 255, 10**9, "2", None]})
    assert board.roll_call is not None
    assert board.roll_call.nodes == [1, 3]


def test_a_mission_has_its_plans_in_its_folder_and_takes_images_alone(tmp_path: Path) -> None:
    mission = Mission.open(tmp_path / "mission", "/dev/ttyUSB0")
    images = PlanImages(mission.path)
    name = images.keep(png(8, 8))
    # Another process, after a restart.
    assert PlanImages(mission.path).find(name) == (png(8, 8), "image/png")
    assert images.find("../secret.key") is None
    (mission.path / "plans" / ("0" * 16 + ".png")).symlink_to(mission.path / "secret.key")
    assert images.find("0" * 16 + ".png") is None
    for rubbish in (b"", b"<svg onload='x'>", b"GIF89a"):
        with pytest.raises(ValueError, match="neither PNG"):
            images.keep(rubbish)
