"""The figures of calls, from samples that are made up."""

from support import running

SAMPLES = """
  const { History } = await import("./history.js");
  const history = new History();
  const sample = (calls, hasFigures = true) => ({ calls, hasFigures, bounds: hasFigures ? [0.1, 1] : [], indices: [] });
  const call = (verb, index, buckets) => {
    const count = buckets.reduce((sum, number) => sum + number, 0);
    return { face: "grpc", verb, index, outcome: "OK", count, buckets };
  };
"""
FIRST_FIGURES = f"""async () => {{ {SAMPLES}
  const rates = () => [history.calls(() => true), ...history.kinds()].map(({{ rate }}) => rate);
  history.add(sample([], false), 0);
  history.add(sample([call("knn", "arm", [5000, 0, 0])]), 1000);
  const before = rates();
  history.add(sample([call("knn", "arm", [5003, 0, 0])]), 2000);
  return [before, rates()];
}}"""
KINDS = f"""async () => {{ {SAMPLES}
  const all = ["knn", "insert", "watch"].flatMap((verb) => ["arm", "leg"].map((index) => [verb, index]));
  for (let round = 0; round < 3; round++) {{
    const grown = (i) => [2 + round * (i + 1), round * i, round];
    // The last kind of all begins after the first sample, and one does not grow.
    const calls = all.map(([verb, index], i) => call(verb, index, i === 2 ? [4, 4, 4] : grown(i)));
    history.add(sample(round === 0 ? calls.slice(0, -1) : calls), 500 * round);
  }}
  return history.kinds().map((kind) => [kind, history.calls(({{ verb, index }}) => verb === kind.verb && index === kind.index)]);
}}"""


def the_first_figures_are_no_calls_of_the_last_minute(page, programs, pictures):
    """They count from the start of the server. The samples before have none: their identity could not read them."""
    with running(programs) as server:
        page.goto(server.page)
        before, after = page.evaluate(FIRST_FIGURES)
        assert before == [0] and after == [3, 3], (before, after)


def kinds_of_calls_have_the_figures_of_their_calls(page, programs, pictures):
    with running(programs) as server:
        page.goto(server.page)
        kinds = page.evaluate(KINDS)
        assert len(kinds) == 5, kinds
        for kind, calls in kinds:
            assert calls["rate"] > 0 and all(kind[name] == calls[name] for name in calls), (kind, calls)
            assert (calls["p50"] is None) == (kind["verb"] == "watch"), calls
        rates = [kind["rate"] for kind, _ in kinds]
        assert rates == sorted(rates, reverse=True), rates
