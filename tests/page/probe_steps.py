"""The probe, against the command line; and the texts that it offers, as they are run."""

import os
import pathlib
import tempfile

from playwright.sync_api import expect

from support import (OUTSIDE, PROBE, SPACE, certify, identities, picture, probe, row, running, showing, sign_in,
                     wait_for_count)
from text_programs import run


def neighbors_of(answer):
    return list(zip(map(str, answer["ids"]), answer["distances"]))


def the_probe_answers_as_the_command_line(page, programs, pictures):
    with showing(page, programs, map(row, range(1000))) as server:
        shown = probe(page, PROBE, 7)
        answer = neighbors_of(server.json("knn", "arm", "--state", PROBE, "-k", "7"))
        assert shown == answer, (shown, answer)
        for state, words in [("1,2", "2 numbers"), ("5,5,1,0,0,0,9", "norm")]:
            page.fill("#probe-state", state)
            page.click("#probe-run")
            expect(page.locator("#probe-error")).to_contain_text(words)
        # The page marks a wrong field, also if it exceeds a limit of the server.
        page.fill("#probe-state", PROBE)
        page.fill("#probe-k", "10001")
        page.click("#probe-run")
        expect(page.locator("#probe-k")).to_have_attribute("aria-invalid", "true")
        expect(page.locator("#probe-error")).to_contain_text("max_k")


def without_webgl2_the_probe_answers(page, programs, pictures):
    """The place of the picture says what is missing."""
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(100)))
        page.goto(f"{server.page}#/arm")
        wait_for_count(page, 100)
        expect(page.locator("#empty")).to_contain_text("WebGL2")
        expect(page.locator("#empty")).to_be_visible()
        shown = probe(page, PROBE, 7)
        assert shown == neighbors_of(server.json("knn", "arm", "--state", PROBE, "-k", "7")), shown


def text_of(page, language):
    page.get_by_role("tab", name=language, exact=True).click()
    return page.locator(f'#snippets [data-language="{language}"] code').inner_text()


def run_as_shown(programs, text, secret, **options):
    """Runs the text for the command line, letter by letter, where `wayfold` is the program of the suite."""
    with tempfile.TemporaryDirectory() as directory:
        (pathlib.Path(directory) / "wayfold").symlink_to(programs / "cli-process")
        path = {"PATH": f"{directory}:{os.environ['PATH']}"}
        return run(["bash", "-c", text], {**secret, **path}, **options).stdout


def rows_of(table):
    """The ids and distances of a table of the command line."""
    lines = [line.split() for line in table.splitlines()]
    header = next(i for i, line in enumerate(lines) if "id" in line)
    at = lines[header].index("id"), lines[header].index("distance")
    return [(line[at[0]], float(line[at[1]])) for line in lines[header + 1:] if len(line) > max(at)]


def the_texts_run(page, programs, pictures, builds):
    """Each finds what the page shows: the command, and with `builds` the others."""
    with running(programs) as server:
        texts_find_what_is_shown(page, server, builds, {})


def the_texts_run_with_a_token_over_tls(page, programs, pictures, builds):
    """The same where a server beyond loopback asks for a token, and has a certificate of an authority of its own."""
    with identities(("admin", "admin", "*")) as (settings, token):
        folder = token("admin").parent
        options = {"settings": {**settings, **certify(folder)}, "host": OUTSIDE}
        with running(programs, **options, options=["--ca", folder / "ca.pem", "--token-file", token("admin")]) as server:
            assert server.page.startswith(f"https://{OUTSIDE}:"), server.page
            texts_find_what_is_shown(page, server, builds, {"WAYFOLD_TOKEN": "admin"}, folder)
            picture(page, pictures, "token")


def texts_find_what_is_shown(page, server, builds, secret, folder=None):
    """The texts run in `folder`, and find `secret` in their environment."""
    server.command("create", "arm", "--space", SPACE)
    server.insert("arm", map(row, range(500)))
    page.goto(f"{server.page}#/arm")
    if secret:
        sign_in(page, *secret.values())
    wait_for_count(page, 500)
    page.fill("#probe-radius", "1.75")
    shown = probe(page, PROBE, 6)
    texts = {language: text_of(page, language) for language in ("Command line", "Rust", "Python", "C++")}
    for text in texts.values():
        assert ("WAYFOLD_TOKEN" in text) == bool(secret) and server.uri in text, text
    found = rows_of(run_as_shown(server.programs, texts.pop("Command line"), secret, cwd=folder))
    assert [id for id, _ in found] == [id for id, _ in shown], (found, shown)
    assert all(abs(a - b) < 1e-4 for (_, a), (_, b) in zip(found, shown)), (found, shown)
    for language, text in texts.items() if builds else ():
        with builds.command(language, text) as command:
            printed = run(command, secret, cwd=folder).stdout
        found = [(id, float(distance)) for id, distance in map(str.split, printed.splitlines())]
        assert found == shown, (language, found, shown)
