//! Loads on one thread, in simulated time: bursts are answered whole, and under lasting load no call waits for long.

use std::collections::VecDeque;

use super::*;

const MS: Duration = Duration::from_millis(1);
const TARGET: Duration = Duration::from_millis(100);
const BURST: Duration = Duration::from_secs(1);
const FLOWS: u64 = 64;

/// The outcomes of the calls of a load.
#[derive(Debug, Default)]
struct Outcomes {
    /// The waits of the accepted calls, ascending.
    waits: Vec<Duration>,
    refused: usize,
}

/// A caller.
#[derive(Debug)]
struct Caller {
    /// The work of each of its calls, what is left of the one under way, and what that has done since it was demoted.
    work: Duration,
    left: Duration,
    at_once: Duration,
    /// The time at which it asks next, and that at which it asked.
    asks_at: Option<Duration>,
    asked_at: Duration,
    /// True if it asks again once it has an answer.
    goes_on: bool,
    /// The caller whose flow it uses too, if it has none of its own.
    shares: Option<usize>,
    /// The times until its calls ended.
    times: Vec<Duration>,
    refused: usize,
}

impl Caller {
    fn new(work: Duration, asks_at: Duration, goes_on: bool) -> Self {
        Self {
            work,
            left: work,
            at_once: Duration::ZERO,
            asks_at: Some(asks_at),
            asked_at: Duration::ZERO,
            goes_on,
            shares: None,
            times: Vec::new(),
            refused: 0,
        }
    }

    /// A caller that shares the flow of the caller with this number.
    fn sharing(first: usize, work: Duration, asks_at: Duration, goes_on: bool) -> Self {
        let shares = Some(first);
        Self {
            shares,
            ..Self::new(work, asks_at, goes_on)
        }
    }

    fn end(&mut self, at: Duration) {
        self.times.push(at - self.asked_at);
        (self.left, self.at_once) = (self.work, Duration::ZERO);
        self.asks_at = self.goes_on.then_some(at);
    }

    fn refuse(&mut self, at: Duration) {
        self.refused += 1;
        self.asks_at = self.goes_on.then_some(at + TARGET);
    }
}

/// Lets callers ask for a time, and polls their calls in slices. The next call goes over the next of `flows`, or each caller
/// has a flow of its own if there are none.
fn run(mut callers: Vec<Caller>, flows: u64, slice: Duration, time: Duration) -> Vec<Caller> {
    let turns = Turns::new(1, TARGET, BURST);
    let own: Vec<FlowNumber> = callers.iter().map(|_| turns.open()).collect();
    let shared: Vec<FlowNumber> = (0..flows).map(|_| turns.open()).collect();
    let mut next_flow = shared.iter().cycle();
    let (began, mut at) = (Instant::now(), Duration::ZERO);
    let mut computing: VecDeque<(usize, Turn)> = VecDeque::new();
    let mut waiting: Vec<(usize, oneshot::Receiver<Granted>)> = Vec::new();
    while at < time {
        let next = computing.pop_front();
        let asking = callers.iter().enumerate();
        let asking = asking.filter_map(|(number, caller)| Some((caller.asks_at?, number)));
        let mut asking: Vec<_> = asking.collect();
        asking.sort();
        at = match (&next, asking.first()) {
            (Some((number, _)), _) => at + callers[*number].left.min(slice),
            (None, Some((asks_at, _))) => at.max(*asks_at),
            (None, None) => break,
        };
        // Calls that come during the slice come before its end.
        for (asks_at, number) in asking.into_iter().take_while(|(asks_at, _)| *asks_at <= at) {
            let caller = &mut callers[number];
            (caller.asked_at, caller.asks_at) = (asks_at, None);
            let flow = next_flow.next().copied();
            let flow = flow.unwrap_or(own[caller.shares.unwrap_or(number)]);
            match turns.request(flow, Stage::New, Duration::ZERO, began + asks_at) {
                Ok(TurnRequest::Granted(turn)) => computing.push_back((number, turn)),
                Ok(TurnRequest::Waits(granted)) => waiting.push((number, granted)),
                Err(Overloaded(_)) => caller.refuse(asks_at),
            }
        }
        if let Some((number, mut turn)) = next {
            let caller = &mut callers[number];
            let took = caller.left.min(slice);
            caller.left -= took;
            caller.at_once += took;
            if caller.left.is_zero() {
                turn.turns = None;
                turns.release(turn.flow, turn.size, took, began + at);
                caller.end(at);
            } else {
                let stage = if caller.at_once >= MAX_AT_ONCE {
                    caller.at_once = Duration::ZERO;
                    Stage::Demoted
                } else if caller.work - caller.left < MAX_WHOLE {
                    Stage::Begun
                } else {
                    Stage::Resumed
                };
                match turns.yield_turn(turn, took, stage, began + at) {
                    TurnRequest::Granted(turn) => computing.push_back((number, turn)),
                    TurnRequest::Waits(granted) => waiting.push((number, granted)),
                }
            }
        }
        waiting.retain_mut(|(number, granted)| match granted.try_recv() {
            Ok(Ok(turn)) => {
                computing.push_back((*number, turn));
                false
            }
            Ok(Err(Overloaded(_))) => {
                callers[*number].refuse(at);
                false
            }
            Err(_) => true,
        });
    }
    callers
}

/// The outcomes of calls that take `work` each and come at `arrivals` after the begin, over [`FLOWS`] flows in turn.
fn simulate(work: Duration, mut arrivals: Vec<Duration>) -> Outcomes {
    arrivals.sort();
    let caller = |at: &Duration| Caller::new(work, *at, false);
    let callers = arrivals.iter().map(caller).collect();
    let callers = run(callers, FLOWS, work, Duration::MAX);
    let ended = callers.iter().flat_map(|caller| &caller.times);
    let mut outcomes = Outcomes {
        waits: ended.map(|time| *time - work).collect(),
        refused: callers.iter().map(|caller| caller.refused).sum(),
    };
    assert_eq!(outcomes.waits.len() + outcomes.refused, arrivals.len());
    outcomes.waits.sort();
    outcomes
}

/// Callers that always ask for these times of work, in slices.
fn closed_loop(works: &[Duration], flows: u64, time: Duration) -> Vec<Caller> {
    let caller = |work: &Duration| Caller::new(*work, Duration::ZERO, true);
    run(
        works.iter().map(caller).collect(),
        flows,
        Duration::from_micros(500),
        time,
    )
}

/// The arrivals of calls at equal distances for a time.
fn steady(gap: Duration, time: Duration) -> Vec<Duration> {
    let calls = (time.as_nanos() / gap.as_nanos()) as u32;
    (0..calls).map(|n| gap * n).collect()
}

/// The arrivals of workers that all ask once a second, each second's spread over a time.
fn bursts(workers: u32, spread: Duration, seconds: u64) -> Vec<Duration> {
    let seconds = (0..seconds).map(Duration::from_secs);
    let burst = |at| (0..workers).map(move |n| at + spread * n / workers);
    seconds.flat_map(burst).collect()
}

#[test]
fn workers_that_all_ask_at_once_are_all_answered() {
    // Together they take 0.6 or 0.9 of a second.
    for work in [Duration::from_secs_f64(0.6 / 64.0), 14 * MS] {
        for spread in [0, 20, 100, 200] {
            let outcomes = simulate(work, bursts(64, spread * MS, 10));
            assert_eq!(outcomes.refused, 0, "{work:?}, spread over {spread} ms");
        }
    }
    // Others ask meanwhile.
    let mut arrivals = bursts(64, 5 * MS, 10);
    arrivals.extend(steady(50 * MS, 10 * BURST));
    assert_eq!(simulate(9 * MS, arrivals).refused, 0);
}

/// 32 callers share one flow, so their calls wait for each other. The workers beside them need 0.45 s of each second.
#[test]
fn workers_are_answered_beside_a_flow_whose_own_calls_always_wait() {
    const HEAVY: usize = 32;
    // Calls are polled in slices, or whole.
    let whole = BURST;
    for (work, slice) in [(3, MS / 2), (3, whole), (30, MS / 2), (30, whole)] {
        let heavy = (0..HEAVY).map(|_| Caller::sharing(0, work * MS, Duration::ZERO, true));
        let burst = bursts(64, Duration::ZERO, 8).into_iter().enumerate();
        let burst = burst.map(|(n, at)| Caller::sharing(HEAVY + n % 64, 7 * MS, at, false));
        let callers = run(heavy.chain(burst).collect(), 0, slice, 9 * BURST);
        let (heavy, burst) = callers.split_at(HEAVY);
        let refused: usize = burst.iter().map(|caller| caller.refused).sum();
        assert_eq!(refused, 0, "{work} ms in {slice:?}");
        assert!(burst.iter().all(|caller| caller.times.len() == 1));
        // The 32 have most of the other time, and their own queue stands.
        let answered: usize = heavy.iter().map(|caller| caller.times.len()).sum();
        assert!(answered as u32 * (work * MS) >= 3 * BURST, "{answered}");
        let refused: usize = heavy.iter().map(|caller| caller.refused).sum();
        assert!(refused > 0, "{work} ms in {slice:?}");
    }
}

/// An overload by others comes and ends while the calls of one flow go on. They are polled in slices, or whole.
#[test]
fn workers_are_answered_after_an_overload_beside_a_flow_of_long_calls() {
    for (heavy, work, slice) in [(8, 300, MS / 2), (2, 60, BURST)] {
        let long = (0..heavy).map(|_| Caller::sharing(0, work * MS, Duration::ZERO, true));
        let overload = steady(5 * MS, 5 * BURST / 2).into_iter();
        let overload = overload.map(|at| (10 * MS, BURST + at));
        let bursts = bursts(64, Duration::ZERO, 4).into_iter();
        let bursts = bursts.map(|at| (7 * MS, 8 * BURST + at));
        let others = overload.chain(bursts).zip((heavy..heavy + 64).cycle());
        let others = others.map(|((work, at), flow)| Caller::sharing(flow, work, at, false));
        let callers = run(long.chain(others).collect(), 0, slice, 13 * BURST);
        let (overload, bursts) = callers[heavy..].split_at(500);
        assert!(overload.iter().any(|caller| caller.refused > 0));
        let refused: usize = bursts.iter().map(|caller| caller.refused).sum();
        assert_eq!(refused, 0, "{heavy} calls of {work} ms");
        assert!(bursts.iter().all(|caller| caller.times.len() == 1));
    }
}

/// The first calls wait for longer: until then the load may be a burst.
#[test]
fn under_lasting_load_calls_wait_for_about_the_target() {
    for times in [2, 4, 10] {
        let work = 10 * MS;
        let outcomes = simulate(work, steady(work / times, 8 * BURST));
        let p99 = outcomes.waits[outcomes.waits.len() * 99 / 100];
        assert!(p99 <= TARGET * 3 / 2, "{times}: {p99:?}");
        let longest = outcomes.waits[outcomes.waits.len() - 1];
        assert!(longest <= TARGET * 5 / 2, "{times}: {longest:?}");
        // The thread was never idle.
        let accepted = outcomes.waits.len();
        assert!(accepted as u32 * work >= 8 * BURST, "{times}: {accepted}");
    }
}

/// Calls that are polled whole are alone in the queue for most of the time.
#[test]
fn long_calls_of_many_flows_wait_for_about_the_target_too() {
    let outcomes = simulate(150 * MS, steady(115 * MS, 120 * BURST));
    let p90 = outcomes.waits[outcomes.waits.len() * 9 / 10];
    assert!(p90 <= TARGET * 3 / 4, "{p90:?}");
}

/// After a pause, a burst is a burst again.
#[test]
fn load_that_ends_is_forgotten() {
    let mut arrivals = steady(5 * MS, BURST);
    arrivals.extend(
        bursts(64, Duration::ZERO, 5)
            .iter()
            .map(|at| 3 * BURST + *at),
    );
    let overload = simulate(9 * MS, steady(5 * MS, BURST));
    assert!(overload.refused > 0);
    let both = simulate(9 * MS, arrivals);
    assert_eq!(both.refused, overload.refused);
}

#[test]
fn long_calls_and_short_ones_share_the_time() {
    for (short, long) in [(64, 1), (64, 4), (64, 16), (16, 4), (4, 16)] {
        let mut works = vec![Duration::from_micros(40); short];
        works.resize(short + long, 3 * MS);
        let (time, all) = (6 * BURST, (short + long) as u32);
        for caller in closed_loop(&works, 0, time) {
            let share = caller.work * caller.times.len() as u32;
            assert!(share >= time / all * 3 / 4, "{short} and {long}: {share:?}");
            assert_eq!(caller.refused, 0, "{short} and {long}");
        }
    }
}

#[test]
fn calls_within_the_capacity_are_served_as_they_come() {
    for callers in [16, 50] {
        let works: Vec<Duration> = (0..callers).map(|n| MS * (10 + n % 5) / 16).collect();
        let callers = closed_loop(&works, 50, 4 * BURST);
        let round: Duration = works.iter().sum();
        for caller in callers {
            assert_eq!(caller.refused, 0);
            let longest = caller.times.iter().max().unwrap();
            assert!(*longest < round * 3, "{longest:?} of {round:?}");
        }
    }
}
