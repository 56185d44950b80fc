"""Looks at the page in a browser, and holds what it shows against the command line. See `run`."""

import argparse
import contextlib
import hashlib
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import tempfile

from playwright.sync_api import Page, expect, sync_playwright

# The most that the page, a process or the browser may take for one step.
MAX_WAIT_S = 120
SPACE = "R3*SO3:0.15"
# Software rendering, and no sandbox: the suite may run as root in a container.
BROWSER = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PROBE = "5,5,1,0,0,0,1"
# Chromium writes this line for each refusal and for each lost connection.
REFUSAL = "Failed to load resource"


class Server:
    """A server and the command line for it."""

    def __init__(self, programs, data="memory", ports=("0", "0"), settings=None):
        self.programs = programs
        arguments = ["--zenoh", "off", "--log", "warn", "--data", data]
        arguments += ["--grpc", f"127.0.0.1:{ports[0]}", "--http", f"127.0.0.1:{ports[1]}"]
        command = [programs / "server-process", *arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=settings)
        self.uri = self.line("listening on ")
        self.page = self.line("metrics at ").removesuffix("metrics")

    def line(self, start):
        line = self.process.stdout.readline().strip()
        assert line.startswith(start), f"the server said {line!r}"
        return line.removeprefix(start)

    def ports(self):
        return [re.search(r":(\d+)/?$", address).group(1) for address in (self.uri, self.page)]

    def command(self, *arguments, **options):
        command = [self.programs / "cli-process", "--server", self.uri, *arguments]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=MAX_WAIT_S, **options)
        return done.stdout

    def json(self, *arguments):
        return json.loads(self.command("--output", "json", *arguments))

    def insert(self, index, rows):
        lines = "".join(",".join(map(str, row)) + "\n" for row in rows)
        self.command("insert", index, "-", input=lines)

    def kill(self):
        self.process.kill()
        self.process.wait()


@contextlib.contextmanager
def running(*arguments, **options):
    server = Server(*arguments, **options)
    try:
        yield server
    finally:
        server.kill()


def launch(driver):
    """Debian's Chromium, without a screen."""
    chromium = shutil.which("chromium")
    assert chromium, "install chromium"
    return driver.chromium.launch(executable_path=chromium, args=BROWSER)


def row(number):
    """A state of SE(3) by its number."""
    return [number % 10, number // 10 % 10, number / 100, 0, 0, 0, 1]


def wait_for_count(page, points):
    expect(page.locator("#count")).to_have_text(re.compile(f"^{points:,} points?"), timeout=MAX_WAIT_S * 1000)


def wait_until_drawn(page):
    page.locator('html[data-ready="1"]').wait_for(state="attached", timeout=MAX_WAIT_S * 1000)


def open_index(page, server, index):
    page.goto(f"{server.page}#/{index}")
    wait_until_drawn(page)


def a_planner_is_seen_growing(page, programs, milestones, pictures):
    """From an empty server to a planner's roadmap, while the page is open."""
    with running(programs) as server, tempfile.TemporaryDirectory() as directory:
        page.goto(server.page)
        expect(page.locator("#indices-empty")).to_be_visible()
        rigid = [programs / "rigid", "--server", server.uri, "--keep", "--workers", "2", "--milestones", str(milestones)]
        with subprocess.Popen(rigid, stdout=subprocess.DEVNULL, cwd=directory, start_new_session=True) as planner:
            link = page.locator("#indices tbody a").first
            expect(link).to_be_visible(timeout=MAX_WAIT_S * 1000)
            # It stands still while the picture opens.
            os.killpg(planner.pid, signal.SIGSTOP)
            index = link.inner_text().strip()
            link.click()
            wait_until_drawn(page)
            begun = int(server.json("info", index)["point_count"])
            wait_for_count(page, begun)
            os.killpg(planner.pid, signal.SIGCONT)
            assert planner.wait(MAX_WAIT_S) == 0
        points = server.json("info", index)["point_count"]
        wait_for_count(page, int(points))
        assert begun < int(points), "the planner was done before the picture opened"
        picture(page, pictures, "roadmap")
        page.goto(f"{server.page}#/")
        expect(page.locator(f'[data-index="{index}"]')).to_contain_text(f"{int(points):,}")
        picture(page, pictures, "overview")


def the_probe_answers_as_the_command_line(page, programs, pictures):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        server.insert("arm", map(row, range(1000)))
        open_index(page, server, "arm")
        wait_for_count(page, 1000)
        page.fill("#probe-state", PROBE)
        page.fill("#probe-k", "7")
        page.click("#probe-run")
        rows = page.locator("#neighbors tr")
        expect(rows).to_have_count(7)
        shown = [(it.get_attribute("data-id"), float(it.get_attribute("data-distance"))) for it in rows.all()]
        answer = server.json("knn", "arm", "--state", PROBE, "-k", "7")
        told = list(zip(map(str, answer["ids"]), answer["distances"]))
        assert shown == told, (shown, told)
        # The same query as a command is a command.
        line = page.locator("#snippets code").first.inner_text()
        assert line.startswith("wayfold ") and "knn arm" in line, line
        picture(page, pictures, "probe")

        for state, words in [("1,2", "2 numbers"), ("5,5,1,0,0,0,9", "norm")]:
            page.fill("#probe-state", state)
            page.click("#probe-run")
            expect(page.locator("#probe-error")).to_contain_text(words)


def the_slider_counts_as_scans_did(page, programs):
    with running(programs) as server:
        server.command("create", "arm", "--space", SPACE)
        counts = {}
        for number in range(5):
            server.insert("arm", map(row, range(100 * number, 100 * number + 10 * (number + 1))))
            index = server.json("info", "arm")
            counts[int(index["revision"]["number"])] = int(index["point_count"])
        open_index(page, server, "arm")
        wait_for_count(page, max(counts.values()))
        # What is removed while the page is open is counted where it still was.
        server.command("remove", "arm", "0", "1")
        wait_for_count(page, max(counts.values()) - 2)
        for revision, points in counts.items():
            page.evaluate("r => { const s = document.getElementById('slider'); s.value = r; "
                          "s.dispatchEvent(new Event('input', { bubbles: true })); }", str(revision))
            expect(page.locator("#revision")).to_have_text(
                re.compile(f"revision {revision:,}: {points:,} points?"), timeout=MAX_WAIT_S * 1000)


def a_server_that_comes_back_is_seen_again(page, programs):
    with tempfile.TemporaryDirectory() as data:
        with running(programs, data=data) as server:
            server.command("create", "arm", "--space", SPACE)
            server.insert("arm", map(row, range(300)))
            open_index(page, server, "arm")
            wait_for_count(page, 300)
            ports = server.ports()
        expect(page.locator("#status")).to_contain_text("trying again", timeout=MAX_WAIT_S * 1000)
        with running(programs, data=data, ports=ports) as server:
            server.insert("arm", map(row, range(300, 400)))
            expect(page.locator("#status")).to_have_text("live", timeout=MAX_WAIT_S * 1000)
            wait_for_count(page, 400)


def a_wrong_role_sees_nothing(page, programs):
    with tempfile.TemporaryDirectory() as directory:
        identities = pathlib.Path(directory) / "identities.toml"
        text = ""
        for name, role, indexes in [("admin", "admin", "*"), ("leg", "read", "leg")]:
            digest = hashlib.sha256(name.encode()).hexdigest()
            text += f'[[identity]]\nname = "{name}"\nrole = "{role}"\nindexes = ["{indexes}"]\ntoken_sha256 = "{digest}"\n'
        identities.write_text(text)
        token = pathlib.Path(directory) / "token"
        token.write_text("admin")
        with running(programs, settings={"WAYFOLD_ACCESS__IDENTITIES": str(identities)}) as server:
            own = ["--token-file", token]
            server.command(*own, "create", "arm", "--space", SPACE)
            server.command(*own, "insert", "arm", "-", input="0,0,0,0,0,0,1\n")
            page.goto(f"{server.page}#/arm")
            expect(page.locator("#token")).to_be_visible()
            page.fill("#token", "wrong")
            page.keyboard.press("Enter")
            expect(page.locator("#sign-in-error")).not_to_be_empty()
            page.fill("#token", "leg")
            page.keyboard.press("Enter")
            expect(page.locator("#notice")).to_contain_text("arm")
            expect(page.locator("#count")).to_have_text(re.compile("^0 points"))
            page.reload()
            page.fill("#token", "admin")
            page.keyboard.press("Enter")
            wait_for_count(page, 1)


def picture(page, directory, name):
    if directory:
        page.wait_for_timeout(500)
        page.screenshot(path=directory / f"{name}.png")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--programs", type=pathlib.Path, required=True)
    parser.add_argument("--milestones", type=int, default=20_000, help="the vertices of the planner's roadmap")
    parser.add_argument("--pictures", type=pathlib.Path, help="the directory of the pictures")
    arguments = parser.parse_args()
    programs = arguments.programs.resolve()
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as driver:
        browser = launch(driver)
        checks = {
            "a planner is seen growing": lambda page: a_planner_is_seen_growing(
                page, programs, arguments.milestones, arguments.pictures),
            "the probe answers as the command line": lambda page: the_probe_answers_as_the_command_line(
                page, programs, arguments.pictures),
            "the slider counts as scans did": lambda page: the_slider_counts_as_scans_did(page, programs),
            "a server that comes back is seen again": lambda page: a_server_that_comes_back_is_seen_again(page, programs),
            "a wrong role sees nothing": lambda page: a_wrong_role_sees_nothing(page, programs),
        }
        for name, check in checks.items():
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            problems = []
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.on("console", lambda line: problems.append(line.text)
                    if line.type == "error" and not line.text.startswith(REFUSAL) else None)
            check(page)
            assert not problems, f"{name}: {problems}"
            page.close()
            print(f"ok: {name}", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
