"""The probe, against the command line; and the texts that it offers, as they are run."""

import os
import pathlib
import subprocess
import tempfile

from playwright.sync_api import expect

from support import MAX_WAIT_S, PROBE, SPACE, identities, open_index, picture, probe, row, running, sign_in, wait_for_count


def told(answer):
    return list(zip(map(str, answer["ids"]), answer["distances"]))


def the_probe_answers_as_the_command_line(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(1000)))
        open_index(page, server, "arm")
        wait_for_count(page, 1000)
        shown = probe(page, PROBE, 7)
        answer = told(server.json("knn", "arm", "--state", PROBE, "-k", "7"))
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


def text_of(page, language):
    page.get_by_role("tab", name=language, exact=True).click()
    return page.locator(f'#snippets [data-language="{language}"] code').inner_text()


def output_of(command, environment):
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=MAX_WAIT_S, env=environment)
    return done.stdout


def run_as_shown(programs, text, **settings):
    """Runs the text for the command line, letter by letter, where `wayfold` is the program of the suite."""
    with tempfile.TemporaryDirectory() as directory:
        (pathlib.Path(directory) / "wayfold").symlink_to(programs / "cli-process")
        environment = {**os.environ, "PATH": f"{directory}:{os.environ['PATH']}", **settings}
        return output_of(["bash", "-c", text], environment)


def rows_of(table):
    """The ids and distances of a table of the command line."""
    lines = [line.split() for line in table.splitlines()]
    header = next(i for i, line in enumerate(lines) if "id" in line)
    at = lines[header].index("id"), lines[header].index("distance")
    return [(line[at[0]], float(line[at[1]])) for line in lines[header + 1:] if len(line) > max(at)]


def the_texts_run(page, programs, pictures):
    """The command finds what the page shows, with a token where the server asks for one; and Python's too, if WAYFOLD_PYTHON
    is an interpreter that has the package."""
    python = os.environ.get("WAYFOLD_PYTHON")
    for has_identities in (False, True):
        with identities(("admin", "admin", "*")) as (settings, token):
            with running(programs, settings=settings if has_identities else None) as server:
                own = ["--token-file", token("admin")] if has_identities else []
                server.command(*own, "create", "arm", "--space", SPACE)
                lines = "".join(",".join(map(str, row(number))) + "\n" for number in range(500))
                server.command(*own, "insert", "arm", "-", input=lines)
                page.goto("about:blank")
                page.goto(f"{server.page}#/arm")
                if has_identities:
                    sign_in(page, "admin")
                wait_for_count(page, 500)
                page.fill("#probe-radius", "1.75")
                shown = probe(page, PROBE, 6)
                command = text_of(page, "Command line")
                assert ("WAYFOLD_TOKEN" in command) == has_identities and server.uri in command, command
                secret = {"WAYFOLD_TOKEN": "admin"} if has_identities else {}
                found = rows_of(run_as_shown(programs, command, **secret))
                assert [id for id, _ in found] == [id for id, _ in shown], (found, shown)
                assert all(abs(a - b) < 1e-4 for (_, a), (_, b) in zip(found, shown)), (found, shown)
                for language in ("Rust", "Python", "C++"):
                    text = text_of(page, language)
                    assert ("WAYFOLD_TOKEN" in text) == has_identities and server.uri in text, text
                if has_identities:
                    picture(page, pictures, "token")
                if python:
                    text = text_of(page, "Python")
                    printed = output_of([python, "-c", text], {**os.environ, **secret})
                    found = [(id, float(distance)) for id, distance in map(str.split, printed.splitlines())]
                    assert found == shown, (found, shown)


TEXTS = """async server => {
  const { snippets } = await import('./snippets.js');
  return snippets({ index: 'arm', state: [1, 2.5], k: 3 }, server).map(({ text }) => text);
}"""


def texts_of_servers_with_tls_have_the_authority(page, programs, pictures):
    with running(programs) as server:
        page.goto(server.page)
        told = {"uri": "https://10.0.0.7:50051", "hasTls": True, "hasIdentities": False}
        for text in page.evaluate(TEXTS, told):
            assert "ca.pem" in text and told["uri"] in text and "TOKEN" not in text, text
        command = page.evaluate(TEXTS, told)[0]
        assert command == "wayfold knn arm --state=1,2.5 -k 3 --server https://10.0.0.7:50051 --ca ca.pem", command
