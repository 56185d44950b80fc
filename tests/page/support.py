"""Servers, the browser, and what all steps of `look.py` do with the page."""

import contextlib
import hashlib
import json
import os
import pathlib
import re
import shutil
import struct
import subprocess
import tempfile
import urllib.request

from playwright.sync_api import expect

# The most that the page, a process or the browser may take for one step.
MAX_WAIT_S = 120
expect.set_options(timeout=MAX_WAIT_S * 1000)
SPACE = "R3*SO3:0.15"
# Software rendering, and no sandbox: the suite may run as root in a container.
BROWSER = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PROBE = "5,5,1,0,0,0,1"
# An address beyond loopback, of the network namespace in which `run` runs the suite.
OUTSIDE = "198.51.100.1"
# Chromium writes this line for each refusal and for each lost connection.
REFUSAL = "Failed to load resource"


class Server:
    """A server and the command line for it."""

    def __init__(self, programs, data="memory", ports=("0", "0"), settings=None, host="127.0.0.1", options=()):
        """`options` are those of each command, such as a token."""
        self.programs, self.options = programs, options
        arguments = ["--zenoh", "off", "--log", "warn", "--data", data]
        arguments += ["--grpc", f"{host}:{ports[0]}", "--http", f"{host}:{ports[1]}"]
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
        command = [self.programs / "cli-process", "--server", self.uri, *self.options, *arguments]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=MAX_WAIT_S, **options)
        return done.stdout

    def json(self, *arguments):
        return json.loads(self.command("--output", "json", *arguments))

    def insert(self, index, rows):
        lines = "".join(",".join(map(str, row)) + "\n" for row in rows)
        self.command("insert", index, "-", input=lines)

    def points(self, index, query):
        """The share of a sample of an index, and the number of points that a stream of it sends."""
        request = urllib.request.Request(f"{self.page}api/v1/{index}/points?{query}", method="POST")
        with urllib.request.urlopen(request, timeout=MAX_WAIT_S) as answer:
            rest = answer.read()
        sent, share = 0, None
        while rest:
            head, body = struct.unpack_from("<II", rest)
            header = json.loads(rest[8:8 + head])
            share = header.get("share", share)
            sent += header["row_count"] if header["kind"] == "points" else 0
            rest = rest[8 + head + body:]
        return {"share": share, "sent": sent}

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


@contextlib.contextmanager
def identities(*known):
    """The settings of a server with identities (name, role, index), whose tokens are their names; and a maker of token files."""
    with tempfile.TemporaryDirectory() as directory:
        folder = pathlib.Path(directory)
        text = ""
        for name, role, index in known:
            digest = hashlib.sha256(name.encode()).hexdigest()
            text += f'[[identity]]\nname = "{name}"\nrole = "{role}"\nindexes = ["{index}"]\ntoken_sha256 = "{digest}"\n'
        (folder / "identities.toml").write_text(text)

        def token(name):
            (folder / name).write_text(name)
            return folder / name

        yield {**os.environ, "WAYFOLD_ACCESS__IDENTITIES": str(folder / "identities.toml")}, token


def certify(folder):
    """Makes an authority in `folder`, and a server's certificate for an address beyond loopback. Returns its settings."""
    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
    issued = ["-CA", "ca.pem", "-CAkey", "ca.key", "-addext", f"subjectAltName = IP:{OUTSIDE}", "-addext",
              "basicConstraints = critical, CA:FALSE"]
    for name, options in {"ca": [], "server": issued}.items():
        command = ["openssl", "req", "-x509", *key, "-subj", f"/CN={name}", "-keyout", f"{name}.key", "-out", f"{name}.pem"]
        subprocess.run([*command, *options], check=True, cwd=folder, stderr=subprocess.DEVNULL)
    return {"WAYFOLD_TLS__CERTIFICATE": f"{folder}/server.pem", "WAYFOLD_TLS__KEY": f"{folder}/server.key"}


def frame(head, body=b""):
    """A frame of a stream that is made up. The body needs no padding."""
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<II", len(text), len(body)) + text + body


def sign_in(page, token):
    expect(page.locator("#token")).to_be_visible()
    page.fill("#token", token)
    page.keyboard.press("Enter")


def streams_of(page, name):
    """The addresses of the streams `name` that the page asks for from now on."""
    urls = []
    page.on("request", lambda request: urls.append(request.url) if re.search(f"/{name}(\\?|$)", request.url) else None)
    return urls


def launch(driver):
    """Debian's Chromium, without a screen."""
    chromium = shutil.which("chromium")
    assert chromium, "install chromium"
    return driver.chromium.launch(executable_path=chromium, args=BROWSER)


def row(number):
    """A state of SE(3) by its number."""
    return [number % 10, number // 10 % 10, number / 100, 0, 0, 0, 1]


def wait_for_count(page, points):
    expect(page.locator("#count")).to_have_text(re.compile(f"^{points:,} points?"))


def wait_until_drawn(page):
    page.locator('html[data-ready="1"]').wait_for(state="attached", timeout=MAX_WAIT_S * 1000)


def open_index(page, server, index):
    page.goto(f"{server.page}#/{index}")
    wait_until_drawn(page)


@contextlib.contextmanager
def showing(page, programs, rows, space=SPACE, **options):
    """A server with the index `arm` of these rows, which the page shows."""
    rows = list(rows)
    with running(programs, **options) as server:
        server.command("create", "arm", "--space", space)
        server.insert("arm", rows)
        open_index(page, server, "arm")
        wait_for_count(page, len(rows))
        yield server


def set_slider(page, revision):
    """Moves the slider to a revision, as a hand does."""
    page.evaluate("r => { const s = document.getElementById('slider'); s.value = r; "
                  "s.dispatchEvent(new Event('input', { bubbles: true })); }", str(revision))


def set_hidden(page, is_hidden):
    """Tells the page that its tab is hidden or shown again. Without a screen, the browser takes all tabs for shown."""
    page.evaluate("hidden => { Object.defineProperty(document, 'hidden', { configurable: true, get: () => hidden }); "
                  "document.dispatchEvent(new Event('visibilitychange')); }", is_hidden)


def probe(page, state, k):
    """Asks for the neighbours of a state, and returns those that the page lists: ids and distances."""
    page.fill("#probe-state", state)
    page.fill("#probe-k", str(k))
    # The rows of an earlier answer stay until the next one.
    page.evaluate("document.getElementById('neighbors').replaceChildren()")
    page.click("#probe-run")
    rows = page.locator("#neighbors tr")
    expect(rows).to_have_count(k)
    expect(page.locator("#answer")).to_be_visible()
    return [(it.get_attribute("data-id"), float(it.get_attribute("data-distance"))) for it in rows.all()]


def picture(page, directory, name):
    if directory:
        page.wait_for_timeout(500)
        page.screenshot(path=directory / f"{name}.png")


def looks(page, directory, name):
    """Pictures in the dark and in the light, on a desk and on a telephone."""
    if not directory:
        return
    for theme in ("dark", "light"):
        page.emulate_media(color_scheme=theme)
        for size, (width, height) in {"wide": (1280, 800), "phone": (390, 844)}.items():
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_timeout(1000)
            picture(page, directory, f"{name}-{theme}-{size}")
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 1280, "height": 800})
