"""The address and the focus."""

from playwright.sync_api import expect

from support import SPACE, row, running, wait_for_count


def the_skip_link_leaves_the_address(page, programs, pictures):
    with running(programs) as server:
        page.goto(server.page)
        expect(page.locator("#indices-empty")).to_be_visible()
        page.keyboard.press("Tab")
        expect(page.locator(".skip")).to_be_focused()
        page.keyboard.press("Enter")
        expect(page.locator("#content")).to_be_focused()
        expect(page.locator("#overview")).to_be_visible()
        assert page.url == server.page, page.url


def a_followed_link_keeps_the_focus_in_the_content(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(10)))
        page.goto(server.page)
        page.locator("#indices tbody a").press("Enter")
        wait_for_count(page, 10)
        expect(page.locator("#content")).to_be_focused()


def an_unknown_address_says_so(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        page.goto(f"{server.page}#/FOO.Bar")
        expect(page.locator("#notice")).to_contain_text("No index has the name FOO.Bar")
        expect(page.locator("#overview")).to_be_visible()
        page.goto(f"{server.page}#/arm,FOO.Bar")
        expect(page.locator("#place")).to_have_text("arm")
        expect(page.locator("#notice")).to_contain_text("No index has the name FOO.Bar")
        page.goto(f"{server.page}#/arm")
        expect(page.locator("#notice")).to_be_hidden()
