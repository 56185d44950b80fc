"""Looks at the page in a browser, and holds what it shows against the command line. See `run`."""

import argparse
import functools
import json
import os
import pathlib
import re
import signal
import subprocess
import tempfile

from playwright.sync_api import expect, sync_playwright

import answer_steps
import color_steps
import edge_steps
import health_steps
import history_steps
import model_steps
import overlay_steps
import parallel_steps
import probe_steps
import projection_steps
import report_steps
import route_steps
import sampling_steps
import time_steps
import token_steps
from support import MAX_WAIT_S, REFUSAL, launch, picture, probe, running, wait_for_count, wait_until_drawn
from text_programs import Builds

SIZE = {"width": 1280, "height": 800}
# The most that the planner may take for its roadmap.
MAX_PLANNER_S = 900
# A state among those of the roadmap of `rigid`.
ROADMAP_PROBE = "5,3,1,0,0,0,1"


def a_planner_is_seen_growing(page, programs, pictures, milestones):
    """From an empty server to a planner's roadmap, while the page is open."""
    with running(programs) as server, tempfile.TemporaryDirectory() as directory:
        page.goto(server.page)
        expect(page.locator("#indices-empty")).to_be_visible()
        rigid = [programs / "rigid", "--server", server.uri, "--keep", "--workers", "2", "--milestones", str(milestones)]
        with subprocess.Popen(rigid, stdout=subprocess.DEVNULL, cwd=directory, start_new_session=True) as planner:
            link = page.locator("#indices tbody a").first
            expect(link).to_be_visible()
            # It stands still while the picture opens.
            os.killpg(planner.pid, signal.SIGSTOP)
            index = link.inner_text().strip()
            link.click()
            wait_until_drawn(page)
            begun = int(server.json("info", index)["point_count"])
            wait_for_count(page, begun)
            os.killpg(planner.pid, signal.SIGCONT)
            assert planner.wait(MAX_PLANNER_S) == 0
        points = int(server.json("info", index)["point_count"])
        wait_for_count(page, points)
        assert points >= milestones, points
        assert begun < points, "the planner was done before the picture opened"
        page.select_option("#color-by", "age")
        page.set_viewport_size({"width": 1120, "height": 860})
        probe(page, ROADMAP_PROBE, 8)
        expect(page.locator("#marks .neighbor")).to_have_count(8)
        picture(page, pictures, "page-probe")
        page.set_viewport_size(SIZE)
        page.goto(f"{server.page}#/")
        expect(page.locator(f'[data-index="{index}"]')).to_contain_text(f"{points:,}")
        picture(page, pictures, "overview")


def the_trees_of_a_planner_are_one_picture(page, programs, pictures):
    """The two trees of `maze`, for the docs."""
    with running(programs) as server, tempfile.TemporaryDirectory() as directory:
        maze = [programs / "maze", "--server", server.uri, "--keep", "--workers", "2"]
        subprocess.run(maze, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=directory, timeout=MAX_WAIT_S)
        listed = map(json.loads, server.command("--output", "json", "list").splitlines())
        indices = {index["name"]: int(index["point_count"]) for index in listed}
        trees = [name for end in ("-start", "-goal") for name in indices if name.endswith(end)]
        page.goto(f"{server.page}#/{','.join(trees)}")
        wait_for_count(page, sum(indices[name] for name in trees))
        expect(page.locator("#legend li")).to_have_text(trees)
        # The third one that the planner leaves stands beside them, before any other.
        expect(page.locator("#layers .layer-name").nth(2)).to_have_text(re.compile("-met$"))
        page.set_viewport_size({"width": 1060, "height": 660})
        wait_until_drawn(page)
        # After a change of its size, the picture has only a part of the points at first.
        page.wait_for_timeout(3000)
        picture(page, pictures, "page-trees")


STEPS = [
    probe_steps.the_probe_answers_as_the_command_line,
    probe_steps.without_webgl2_the_probe_answers,
    answer_steps.an_answer_is_not_shown_beside_an_error,
    answer_steps.an_answer_is_about_one_index,
    answer_steps.an_answer_beside_the_past_says_so,
    answer_steps.a_late_point_gives_way_to_what_came_after_it,
    answer_steps.an_answer_says_how_many_are_drawn,
    answer_steps.enter_probes_the_point_in_the_middle,
    time_steps.the_slider_counts_as_scans_did,
    time_steps.what_the_window_does_not_have_is_said,
    time_steps.a_point_of_the_past_is_probed_where_it_stood,
    time_steps.an_index_that_is_made_again_is_shown_at_its_newest,
    time_steps.a_hidden_tab_reads_no_past,
    time_steps.a_cut_within_a_message_counts_no_point_twice,
    model_steps.histories_are_those_of_a_model,
    edge_steps.edges_follow_the_payloads,
    edge_steps.edges_need_a_declaration,
    sampling_steps.a_sample_goes_on_after_a_cut,
    sampling_steps.the_slider_of_a_sample_tells_estimates,
    sampling_steps.an_index_that_grows_is_sampled_again,
    projection_steps.projections_are_the_geometry,
    projection_steps.numbers_of_axes_tell_their_steps,
    overlay_steps.many_indices_leave_room_for_calls,
    overlay_steps.a_hidden_tab_leaves_its_connections,
    overlay_steps.long_names_are_told_apart,
    parallel_steps.joints_are_lines,
    parallel_steps.lines_are_sampled_and_follow_the_slider,
    color_steps.colors_are_told_apart,
    color_steps.any_run_of_tag_bits_gives_the_colour,
    report_steps.the_report_of_a_load_is_one_page,
    route_steps.the_skip_link_leaves_the_address,
    route_steps.a_followed_link_keeps_the_focus_in_the_content,
    route_steps.an_unknown_address_says_so,
    health_steps.a_server_that_comes_back_is_seen_again,
    token_steps.a_token_that_no_header_carries_is_refused,
    token_steps.another_token_can_be_used,
    token_steps.a_token_may_be_typed_slowly,
    health_steps.the_addresses_of_a_new_start_are_shown,
    health_steps.too_many_streams_say_what_helps,
    health_steps.damaged_and_lagging_indices_come_first,
    health_steps.a_silent_server_is_noticed,
    health_steps.a_quiet_index_is_no_silence,
    health_steps.a_failed_description_is_asked_for_again,
    health_steps.streams_are_no_latencies,
    history_steps.the_first_figures_are_no_calls_of_the_last_minute,
    history_steps.kinds_of_calls_have_the_figures_of_their_calls,
    health_steps.a_wrong_role_sees_nothing,
    health_steps.an_identity_of_some_indices_has_no_figures,
]


def take(browser, step, programs, pictures):
    """One step, with a page of its own, which writes no line on the console of the browser but those of refusals."""
    # The browser does not know the authorities of the suite.
    page = browser.new_page(viewport=SIZE, ignore_https_errors=True)
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda line: None if line.text.startswith(REFUSAL) else problems.append(line.text))
    step(page, programs, pictures)
    assert not problems, f"{name_of(step)}: {problems}"
    page.close()


def name_of(step):
    return getattr(step, "func", step).__name__.replace("_", " ")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--programs", type=pathlib.Path, required=True)
    parser.add_argument("--milestones", type=int, default=100_000, help="the vertices of the planner's roadmap")
    parser.add_argument("--pictures", type=pathlib.Path, help="the directory of the pictures")
    parser.add_argument("--texts", type=pathlib.Path, help="a target directory, to run the texts for Rust, Python and C++")
    parser.add_argument("--only", help="take only the steps whose names contain this")
    arguments = parser.parse_args()
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    builds = Builds(arguments.texts) if arguments.texts else None
    first = [
        functools.partial(a_planner_is_seen_growing, milestones=arguments.milestones),
        functools.partial(probe_steps.the_texts_run, builds=builds),
        functools.partial(probe_steps.the_texts_run_with_a_token_over_tls, builds=builds),
    ]
    with sync_playwright() as driver:
        browser = launch(driver)
        # The planner of the trees takes ten seconds more, and other steps show the same.
        steps = [*first, *STEPS, *([the_trees_of_a_planner_are_one_picture] if arguments.pictures else [])]
        for step in steps:
            if arguments.only and arguments.only not in name_of(step):
                continue
            take(browser, step, arguments.programs.resolve(), arguments.pictures)
            print(f"ok: {name_of(step)}", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
