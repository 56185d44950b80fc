"""The colours: people with any colour vision tell those of categories apart, and text stands out from what is behind it."""

import itertools
import pathlib
import random
import re

from support import running

ROOT = pathlib.Path(__file__).parent.parent.parent
# The least distance in CIELAB between two categories. At 2.3 the eye just tells two colours apart.
LEAST_DISTANCE = 20
# WCAG 2, AA.
LEAST_CONTRAST = 4.5
# Machado, Oliveira and Fernandes 2009, at their greatest severity: matrices for linear RGB, row by row.
VISIONS = {
    "usual": [(1, 0, 0), (0, 1, 0), (0, 0, 1)],
    "protanopia": [(0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)],
    "deuteranopia": [(0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)],
    "tritanopia": [(1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)],
}


def linear(color):
    """The linear parts of `#rrggbb`, from 0 to 1."""
    parts = [int(color[at:at + 2], 16) / 255 for at in (1, 3, 5)]
    return [it / 12.92 if it <= 0.04045 else ((it + 0.055) / 1.055) ** 2.4 for it in parts]


def cielab(red, green, blue):
    """For the white of D65."""
    x = (0.4124564 * red + 0.3575761 * green + 0.1804375 * blue) / 0.95047
    y = 0.2126729 * red + 0.7151522 * green + 0.0721750 * blue
    z = (0.0193339 * red + 0.1191920 * green + 0.9503041 * blue) / 1.08883
    x, y, z = (it ** (1 / 3) if it > 216 / 24389 else (24389 / 27 * it + 16) / 116 for it in (x, y, z))
    return 116 * y - 16, 500 * (x - y), 200 * (y - z)


def seen(color, vision):
    parts = linear(color)
    return cielab(*(min(max(sum(a * b for a, b in zip(row, parts)), 0), 1) for row in VISIONS[vision]))


def distance(one, other, vision):
    return sum((a - b) ** 2 for a, b in zip(seen(one, vision), seen(other, vision))) ** 0.5


def luminance(color):
    return sum(a * b for a, b in zip((0.2126, 0.7152, 0.0722), linear(color)))


def contrast(one, other):
    dark, light = sorted(map(luminance, (one, other)))
    return (light + 0.05) / (dark + 0.05)


def colors_are_told_apart(page, programs, pictures):
    with running(programs) as server:
        page.goto(server.page)
        palettes = {}
        for theme in ("light", "dark"):
            page.emulate_media(color_scheme=theme)
            colors = palettes[theme] = page.evaluate("async () => (await import('./palette.js')).categories()")
            assert len(colors) == 8, colors
            pairs = itertools.product(itertools.combinations(colors, 2), VISIONS)
            least = min((distance(*pair, vision), theme, pair, vision) for pair, vision in pairs)
            assert least[0] >= LEAST_DISTANCE, least
            variable = "name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim()"
            for text, behind in itertools.product(("ink", "soft", "faint", "good", "bad", "link"), ("page", "card", "field")):
                found = contrast(*(page.evaluate(variable, name) for name in (text, behind)))
                assert found >= LEAST_CONTRAST, (theme, text, behind, found)
    # The planners' pictures and the load report have the same colours.
    drawing = (ROOT / "examples/src/planning/drawing.rs").read_text().split("pub const WORKERS")[1].split("];")[0]
    workers = ["#" + "".join(f"{int(part):02x}" for part in parts) for parts in re.findall(r"RGBColor\((\d+), (\d+), (\d+)\)", drawing)]
    assert workers == palettes["light"], workers
    report = (ROOT / "client/cli/src/load/report/style.css").read_text()
    drawn = re.findall(r"--(?:insert|knn|query|get|stream|failed|p50|p99): (#\w+)", report)
    assert len(drawn) == 16 and set(drawn[:8]) <= set(palettes["light"]) and set(drawn[8:]) <= set(palettes["dark"]), drawn


def any_run_of_tag_bits_gives_the_colour(page, programs, pictures):
    """Also bits in both halves of a tag."""
    draw = random.Random(7)
    runs = [(draw.getrandbits(64), first, bits) for first in range(64) for bits in (1, 2, 3)]
    arguments = [(tag & 0xFFFFFFFF, tag >> 32, first, bits) for tag, first, bits in runs]
    with running(programs) as server:
        page.goto(server.page)
        given = page.evaluate("async all => { const { bitsOf } = await import('./view_panel.js'); return all.map((it) => bitsOf(...it)); }", arguments)
    assert given == [tag >> first & (1 << bits) - 1 for tag, first, bits in runs]
