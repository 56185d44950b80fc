use super::{Stage::*, *};

const MS: Duration = Duration::from_millis(1);
const TARGET: Duration = Duration::from_millis(100);
const BURST: Duration = Duration::from_secs(3600);

/// A turn at once.
fn take(turns: &Arc<Turns>, flow: FlowNumber) -> Turn {
    match turns
        .request(flow, New, Duration::ZERO, Instant::now())
        .unwrap()
    {
        TurnRequest::Granted(turn) => turn,
        other => panic!("{other:?}"),
    }
}

/// A call that waits since some time ago.
fn wait(
    turns: &Arc<Turns>,
    flow: FlowNumber,
    stage: Stage,
    ago: Duration,
) -> oneshot::Receiver<Granted> {
    match turns
        .request(flow, stage, Duration::ZERO, Instant::now() - ago)
        .unwrap()
    {
        TurnRequest::Waits(granted) => granted,
        other => panic!("{other:?}"),
    }
}

/// Asks for the next turn of a call that goes on.
fn go_on(turns: &Arc<Turns>, turn: Turn, took: Duration, stage: Stage) -> TurnRequest {
    turns.yield_turn(turn, took, stage, Instant::now())
}

/// Ends `turn` after `took`; returns the number of the waiting call that has the next turn, and the turn.
fn next(
    turn: Turn,
    took: Duration,
    waiting: &mut [oneshot::Receiver<Granted>],
) -> Option<(usize, Turn)> {
    turn.end(took);
    let granted = |granted: &mut oneshot::Receiver<Granted>| granted.try_recv().ok();
    waiting
        .iter_mut()
        .enumerate()
        .find_map(|(number, waits)| Some((number, granted(waits)?.unwrap())))
}

#[test]
fn the_flow_that_has_computed_least_goes_first() {
    let turns = Turns::new(1, TARGET, BURST);
    let (heavy, light) = (turns.open(), turns.open());
    // Work before the first call waits is not charged to the order.
    take(&turns, heavy).end(1000 * MS);
    let turn = take(&turns, heavy);
    let mut waiting = vec![
        wait(&turns, heavy, New, MS),
        wait(&turns, heavy, New, MS),
        wait(&turns, light, New, MS),
        wait(&turns, light, New, MS),
    ];
    let (first, turn) = next(turn, 3 * MS, &mut waiting).unwrap();
    let (second, turn) = next(turn, MS, &mut waiting).unwrap();
    let (third, turn) = next(turn, 3 * MS, &mut waiting).unwrap();
    let (fourth, turn) = next(turn, MS, &mut waiting).unwrap();
    assert_eq!([first, second, third, fourth], [2, 3, 0, 1]);
    assert!(next(turn, MS, &mut waiting).is_none());
    // An idle flow has saved nothing: both are even again.
    let turn = take(&turns, heavy);
    turn.end(5 * MS);
    let turn = take(&turns, light);
    let mut waiting = vec![wait(&turns, light, New, MS), wait(&turns, heavy, New, MS)];
    let (first, _turn) = next(turn, 10 * MS, &mut waiting).unwrap();
    assert_eq!(first, 1);
}

#[test]
fn a_call_that_has_begun_goes_first_until_it_has_computed_for_long() {
    let turns = Turns::new(1, TARGET, BURST);
    let flow = turns.open();
    let turn = take(&turns, flow);
    let mut waiting = vec![
        wait(&turns, flow, Demoted, MS),
        wait(&turns, flow, New, MS),
        wait(&turns, flow, New, MS),
        wait(&turns, flow, Resumed, MS),
    ];
    let mut turn = Some(turn);
    for expected in [3, 1, 0, 2] {
        let (first, following) = next(turn.take().unwrap(), MS, &mut waiting).unwrap();
        assert_eq!(first, expected);
        turn = Some(following);
    }
}

#[test]
fn work_that_goes_on_gives_way_only_if_others_wait() {
    let turns = Turns::new(1, TARGET, BURST);
    let (heavy, light) = (turns.open(), turns.open());
    let turn = match go_on(&turns, take(&turns, heavy), 5 * MS, Resumed) {
        TurnRequest::Granted(turn) => turn,
        waits => panic!("{waits:?}"),
    };
    let mut first = wait(&turns, light, New, MS);
    let mut going_on = match go_on(&turns, turn, 5 * MS, Resumed) {
        TurnRequest::Waits(waits) => waits,
        granted => panic!("{granted:?}"),
    };
    assert!(going_on.try_recv().is_err());
    first.try_recv().unwrap().unwrap().end(MS);
    going_on.try_recv().unwrap().unwrap().end(MS);
}

#[test]
fn even_flows_are_served_as_they_come() {
    let turns = Turns::new(1, TARGET, BURST);
    let [third, second, first, begun] = [(); 4].map(|()| turns.open());
    let turn = take(&turns, begun);
    let mut waiting = [first, second, third].map(|flow| wait(&turns, flow, New, MS));
    let mut turn = Some(turn);
    for expected in 0..3 {
        let (served, following) = next(turn.take().unwrap(), MS, &mut waiting).unwrap();
        assert_eq!(served, expected);
        turn = Some(following);
    }
}

#[test]
fn a_call_that_has_just_begun_goes_on_unless_one_of_short_turns_waits() {
    let turns = Turns::new(1, TARGET, BURST);
    let [short, begun, other] = [(); 3].map(|()| turns.open());
    take(&turns, short).end(MS / 1000);
    take(&turns, other).end(MS);
    let turn = take(&turns, begun);
    let mut waits = wait(&turns, other, New, MS);
    let TurnRequest::Granted(turn) = go_on(&turns, turn, MS, Begun) else {
        panic!("it ends before the other begins");
    };
    let mut first = wait(&turns, short, New, MS);
    let TurnRequest::Waits(mut goes_on) = go_on(&turns, turn, MS, Begun) else {
        panic!("a call of short turns waits");
    };
    first.try_recv().unwrap().unwrap().end(MS / 1000);
    waits.try_recv().unwrap().unwrap().end(MS);
    let turn = goes_on.try_recv().unwrap().unwrap();
    let mut waits = wait(&turns, other, New, MS);
    let TurnRequest::Waits(mut goes_on) = go_on(&turns, turn, MS, Resumed) else {
        panic!("it has computed for long, and others wait");
    };
    waits.try_recv().unwrap().unwrap().end(10 * MS);
    goes_on.try_recv().unwrap().unwrap().end(MS);
}

#[test]
fn a_turn_that_goes_on_without_work_leaves_the_mean_of_its_flow() {
    let turns = Turns::new(1, TARGET, BURST);
    let flow = turns.open();
    let work = Duration::from_micros(80);
    take(&turns, flow).end(work);
    for _ in 0..20 {
        let turn = take(&turns, flow);
        assert!(turn.is_long());
        let TurnRequest::Granted(turn) = go_on(&turns, turn, Duration::ZERO, Stage::Resumed) else {
            panic!("no other waits");
        };
        turn.end(work);
    }
}

#[test]
fn a_call_whose_caller_has_left_is_passed_over_and_returns_the_turn() {
    let turns = Turns::new(1, TARGET, BURST);
    let flow = turns.open();
    let turn = take(&turns, flow);
    drop(wait(&turns, flow, New, MS));
    let granted = wait(&turns, flow, New, MS);
    let mut last = vec![wait(&turns, flow, New, MS)];
    turn.end(MS);
    // It has its turn, and does not use it.
    drop(granted);
    let turn = last.remove(0).try_recv().unwrap().unwrap();
    assert!(next(turn, MS, &mut []).is_none());
    take(&turns, flow).end(MS);
}

#[test]
fn a_call_of_a_burst_waits() {
    let turns = Turns::new(1, TARGET, BURST);
    let flow = turns.open();
    let turn = take(&turns, flow);
    let mut late = wait(&turns, flow, New, 2 * TARGET);
    turn.end(MS);
    late.try_recv().unwrap().unwrap().end(MS);
    assert_eq!(turns.refused(), 0);
}

#[test]
fn calls_that_are_never_refused_refuse_no_others() {
    let turns = Turns::new(1, TARGET, BURST);
    let (flow, patient) = (turns.open(), turns.open_patient());
    let turn = take(&turns, flow);
    let mut listing = wait(&turns, patient, New, 2 * BURST);
    let mut late = wait(&turns, flow, New, 2 * TARGET);
    turn.end(MS);
    listing.try_recv().unwrap().unwrap().end(MS);
    late.try_recv().unwrap().unwrap().end(MS);
    assert_eq!(turns.refused(), 0);
}

#[test]
fn one_long_call_alone_is_no_queue() {
    let turns = Turns::new(1, MS, TARGET);
    let flow = turns.open();
    let turn = take(&turns, flow);
    turns.state.lock().was_empty -= 2 * TARGET;
    let TurnRequest::Granted(turn) = go_on(&turns, turn, 2 * TARGET, Resumed) else {
        panic!("nobody else waits");
    };
    let mut waits = wait(&turns, flow, New, TARGET / 2);
    turn.end(MS);
    waits.try_recv().unwrap().unwrap().end(MS);
    assert_eq!(turns.refused(), 0);
}

#[test]
fn a_late_call_of_a_standing_queue_is_refused_and_so_are_those_that_would_be_late() {
    let turns = Turns::new(1, TARGET, MS);
    let flow = turns.open();
    let turn = take(&turns, flow);
    let mut begun = wait(&turns, flow, Resumed, 2 * TARGET);
    let mut late = wait(&turns, flow, New, 2 * TARGET);
    let mut in_time = wait(&turns, flow, New, TARGET * 3 / 4);
    let mut last = wait(&turns, flow, New, MS);
    turn.end(MS);
    begun.try_recv().unwrap().unwrap().end(MS);
    assert_eq!(late.try_recv().unwrap().err(), Some(Overloaded(TARGET)));
    let turn = in_time.try_recv().unwrap().unwrap();
    let other = turns.request(flow, New, Duration::ZERO, Instant::now());
    assert_eq!(other.err(), Some(Overloaded(TARGET)));
    turn.end(MS);
    last.try_recv().unwrap().unwrap().end(MS);
    assert_eq!(turns.refused(), 2);
}

#[test]
fn a_thread_has_one_long_turn_or_many_short_ones() {
    let turns = Turns::new(1, TARGET, BURST);
    // Turns are long until they are known to be short.
    let (long, short) = (turns.open(), turns.open());
    take(&turns, short).end(MS / 1000);
    let mut held: Vec<Turn> = (0..SHORT_TURNS).map(|_| take(&turns, short)).collect();
    let mut third = wait(&turns, long, New, MS);
    let mut fourth = wait(&turns, short, New, MS);
    let last = held.pop();
    drop(held);
    assert!(third.try_recv().is_err() && fourth.try_recv().is_err());
    drop(last);
    let third = third.try_recv().unwrap().unwrap();
    assert!(fourth.try_recv().is_err());
    third.end(MS);
    fourth.try_recv().unwrap().unwrap().end(MS);
}

#[test]
fn threads_bound_the_long_turns_and_none_is_lost() {
    let turns = Turns::new(3, TARGET, BURST);
    let flow = turns.open();
    take(&turns, flow).end(MS);
    let held: Vec<Turn> = (0..3).map(|_| take(&turns, flow)).collect();
    let mut waiting: Vec<_> = (0..5).map(|_| wait(&turns, flow, New, MS)).collect();
    assert!(waiting.iter_mut().all(|waits| waits.try_recv().is_err()));
    drop(held);
    let mut granted: Vec<Turn> = waiting
        .iter_mut()
        .filter_map(|waits| waits.try_recv().ok()?.ok())
        .collect();
    assert_eq!(granted.len(), 3);
    turns.close(flow);
    granted.clear();
    let other = turns.open();
    take(&turns, other).end(MS);
    let _all: Vec<Turn> = (0..3).map(|_| take(&turns, other)).collect();
}
