"""Tokens that the page asks for."""

from playwright.sync_api import expect

from support import PROBE, SPACE, identities, running, sign_in, wait_for_count


def a_token_that_no_header_carries_is_refused(page, programs, pictures):
    with identities(("admin", "admin", "*")) as (settings, _):
        with running(programs, settings=settings) as server:
            page.goto(server.page)
            for token in ("日本", "two words"):
                page.evaluate("document.getElementById('sign-in-error').textContent = ''")
                sign_in(page, token)
                expect(page.locator("#sign-in-error")).to_contain_text("A token has only")
            sign_in(page, "admin")
            expect(page.locator("#status")).to_have_text("live")


def another_token_can_be_used(page, programs, pictures):
    """Where the first one is of an identity that may not see the index."""
    with identities(("admin", "admin", "*"), ("leg", "read", "leg")) as (settings, token):
        with running(programs, settings=settings, options=["--token-file", token("admin")]) as server:
            server.command("create", "arm", "--space", SPACE)
            server.command("insert", "arm", "-", input="0,0,0,0,0,0,1\n")
            page.goto(f"{server.page}#/arm")
            sign_in(page, "leg")
            another = page.get_by_role("button", name="Use another token")
            expect(another).to_be_visible()
            # The probe has the server's words too.
            page.fill("#probe-state", PROBE)
            page.click("#probe-run")
            expect(page.locator("#probe-error")).to_have_text(page.locator("#problems").inner_text())
            # Escape keeps the present one.
            another.click()
            page.keyboard.press("Escape")
            expect(page.locator("#sign-in")).to_be_hidden()
            expect(another).to_be_visible()
            another.click()
            sign_in(page, "admin")
            wait_for_count(page, 1)
            expect(page.locator("#status")).to_have_text("live")
            expect(page.locator("#notice")).to_be_hidden()


def a_token_may_be_typed_slowly(page, programs, pictures):
    """The time that a person takes is no silence of the server."""
    with identities(("admin", "admin", "*")) as (settings, _):
        with running(programs, settings=settings) as server:
            page.clock.install()
            page.goto(server.page)
            expect(page.locator("#token")).to_be_visible()
            page.evaluate("() => { const status = document.getElementById('status'); window.told = []; "
                          "new MutationObserver(() => told.push(status.textContent)).observe(status, { childList: true }); }")
            page.clock.fast_forward(60_000)
            sign_in(page, "admin")
            expect(page.locator("#status")).to_have_text("live")
            told = page.evaluate("told")
            assert not any("no word" in it for it in told), told
