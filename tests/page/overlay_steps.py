"""Several indices in one picture."""

from playwright.sync_api import expect

from support import MAX_WAIT_S, PROBE, SPACE, probe, row, running, wait_for_count


def many_indices_leave_room_for_calls(page, programs, pictures):
    """A browser has six connections for a server without TLS, and each index takes one."""
    names = [f"arm-{number}" for number in range(6)]
    with running(programs) as server:
        for name in names:
            server.command("create", name, "--space", SPACE)
            server.insert(name, map(row, range(100)))
            server.command("remove", name, "7")
        page.goto(f"{server.page}#/{','.join(names)}")
        wait_for_count(page, 4 * 99)
        expect(page.locator("#notice")).to_have_text("At most 4 indices are shown in one picture.")
        page.click("#slider")
        expect(page.locator("#revision-notes")).not_to_contain_text("reading", timeout=MAX_WAIT_S * 1000)
        page.click("#live")
        answer = server.json("knn", names[0], "--state", PROBE, "-k", "5")
        assert probe(page, PROBE, 5) == list(zip(map(str, answer["ids"]), answer["distances"]))
        # Their revisions are numbered alike, so the slider counts all.
        page.evaluate("() => { const s = document.getElementById('slider'); s.value = 1; s.dispatchEvent(new Event('input')); }")
        expect(page.locator("#revision")).to_have_text("revision 1: 400 points")
        page.goto(f"{server.page}#/{','.join(names[:2])}")
        expect(page.locator("#notice")).to_be_hidden()
