//! The connections that make room for others.

use std::{
    convert::Infallible,
    pin::pin,
    task::{Context, Waker},
};

use bytes::Bytes;
use futures_util::poll;
use http_body_util::Full;
use tokio::time::{advance, timeout};

use super::{
    cut::{LOOK_INTERVAL, MAX_STANDING_TIME, STANDING_TIME, WAIT_LOOK_INTERVAL},
    places::{MAX_GUESTS, MAX_SILENCE, MAX_WAIT, MIN_IDLE},
    *,
};
use crate::{admission::HeldBytes, config::Config};

fn is_guest(open: Option<&Open>) -> bool {
    open.is_some_and(|open| open.activity().check_place().is_err())
}

/// Two connections fill the table. Each has a stream: one is silent, over the other an answer leaves now and then.
#[tokio::test(start_paused = true)]
async fn a_silent_stream_makes_room_only_after_its_time() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(2, 1, admission);
    let cuts = [CancellationToken::new(), CancellationToken::new()];
    let silent = connections.open(None, cuts[0].clone()).await.unwrap();
    let live = connections.open(None, cuts[1].clone()).await.unwrap();
    let _streams = [silent.activity().begin(), live.activity().begin()];
    let third = connections.open(None, CancellationToken::new()).await;
    let is_guest = || is_guest(third.as_ref());
    let step = MAX_SILENCE / 10;
    while silent.activity().silence() < MAX_SILENCE {
        assert!(is_guest());
        assert!(!cuts[0].is_cancelled());
        drop(live.activity().send(1));
        advance(step).await;
    }
    assert!(is_guest());
    assert!(cuts[0].is_cancelled() && !cuts[1].is_cancelled());
    drop(silent);
    assert!(!is_guest());
    assert!(!cuts[1].is_cancelled());
}

#[tokio::test(start_paused = true)]
async fn a_cut_connection_that_does_not_end_is_not_the_only_one_cut() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(2, 1, admission);
    let cuts = [CancellationToken::new(), CancellationToken::new()];
    let _first = connections.open(None, cuts[0].clone()).await.unwrap();
    let _second = connections.open(None, cuts[1].clone()).await.unwrap();
    let third = connections.open(None, CancellationToken::new());
    assert!(timeout(10 * MIN_IDLE, third).await.is_err());
    assert!(cuts.iter().all(CancellationToken::is_cancelled));
}

/// Two networks fill the table with calls that are never silent.
#[tokio::test(start_paused = true)]
async fn the_network_with_the_most_connections_makes_room() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(5, 1, admission);
    let peers = [
        "192.0.2.1:1",
        "192.0.2.1:2",
        "[2001:db8::1]:1",
        "[2001:db8::2]:1",
        "[2001:db8::3]:1",
    ];
    let mut open = Vec::new();
    for peer in peers {
        let cut = CancellationToken::new();
        let place = connections.open(peer.parse().ok(), cut.clone()).await;
        let place = place.unwrap();
        let call = place.activity().begin();
        open.push((place, call, cut));
    }
    // The first of the three has called last.
    drop(open[2].0.activity().begin());
    let open_one = |peer: &str| connections.open(peer.parse().ok(), CancellationToken::new());
    // One of the network that has the most, and one of another.
    let mut own = pin!(open_one("[2001:db8::4]:1"));
    let mut newcomer = pin!(open_one("192.0.2.2:1"));
    let is_cut = |open: &[(Open, _, CancellationToken)]| {
        let cut = open.iter().map(|(.., cut)| cut.is_cancelled());
        cut.collect::<Vec<_>>()
    };
    for _ in 0..10 {
        assert!(poll!(own.as_mut()).is_pending());
        assert!(poll!(newcomer.as_mut()).is_pending());
        assert_eq!(is_cut(&open), [false; 5]);
        for (place, ..) in &open {
            place.activity().note_arrival(1);
        }
        advance(MIN_IDLE).await;
    }
    assert!(is_guest(own.await.as_ref()));
    assert_eq!(is_cut(&open), [false; 5]);
    assert!(poll!(newcomer.as_mut()).is_pending());
    assert_eq!(is_cut(&open), [false, false, false, true, false]);
    drop(open.remove(3));
    assert!(newcomer.await.is_some());
}

/// The listener takes new connections one after another.
#[tokio::test(start_paused = true)]
async fn many_guests_do_not_keep_others_out() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(3, 1, admission);
    let open_one = |peer: &str| connections.open(peer.parse().ok(), CancellationToken::new());
    let mut open = Vec::new();
    for peer in ["192.0.2.1:1", "192.0.2.1:2", "192.0.2.1:3"] {
        let place = open_one(peer).await.unwrap();
        let call = place.activity().begin();
        open.push((place, call));
    }
    let mut guests = Vec::new();
    let opening = async {
        for _ in 0..MAX_GUESTS {
            guests.push(open_one("192.0.2.1:4").await);
        }
        // All have just come.
        for _ in 0..20 {
            assert!(open_one("192.0.2.1:4").await.is_none());
        }
    };
    timeout(2 * MAX_WAIT, opening).await.expect("one wait");
    assert!(guests.iter().all(|guest| is_guest(guest.as_ref())));
    let mut newcomer = pin!(open_one("192.0.2.2:1"));
    assert!(poll!(newcomer.as_mut()).is_pending());
    let is_cut = |open: &Open| open.activity.state.cut.is_cancelled();
    drop(open.remove(open.iter().position(|(open, _)| is_cut(open)).unwrap()));
    let newcomer = newcomer.await.unwrap();
    let _call = newcomer.activity().begin();
    // One that comes long after the last one waits again, and the first guest leaves for it.
    let mut last = pin!(open_one("192.0.2.1:4"));
    assert!(timeout(MAX_WAIT / 2, last.as_mut()).await.is_err());
    assert!(last.await.is_none());
    let cut: Vec<_> = guests.iter().flatten().map(is_cut).collect();
    assert_eq!(cut.iter().position(|is_cut| *is_cut), Some(0));
    assert_eq!(cut.iter().filter(|is_cut| **is_cut).count(), 1);
}

#[tokio::test(start_paused = true)]
async fn a_guest_gets_the_place_of_one_that_ends() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(1, 1, admission);
    let first = connections.open(None, CancellationToken::new()).await;
    let first = first.unwrap();
    let _call = first.activity().begin();
    let waiting = connections.open(None, CancellationToken::new());
    let guests = [
        waiting.await,
        connections.open(None, CancellationToken::new()).await,
    ];
    assert!(guests.iter().all(|guest| is_guest(guest.as_ref())));
    drop(first);
    assert!(!is_guest(guests[0].as_ref()));
    assert!(is_guest(guests[1].as_ref()));
    assert!(!is_guest(guests[0].as_ref()));
}

#[tokio::test(start_paused = true)]
async fn the_calls_of_a_guest_give_one_connection_up() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(3, 1, admission);
    let mut cuts = Vec::new();
    let mut open = Vec::new();
    for _ in 0..3 {
        let cut = CancellationToken::new();
        let silent = connections.open(None, cut.clone()).await.unwrap();
        open.push((silent.activity().begin(), silent));
        cuts.push(cut);
    }
    let guest = connections.open(None, CancellationToken::new()).await;
    advance(MAX_SILENCE).await;
    for _ in 0..3 {
        assert!(is_guest(guest.as_ref()));
    }
    assert_eq!(cuts.iter().filter(|cut| cut.is_cancelled()).count(), 1);
}

#[tokio::test(start_paused = true)]
async fn the_longest_backlog_goes_once_the_budget_of_all_is_spent() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let budget = admission.bytes().1 as usize / 4;
    let connections = Connections::new(4, 1, admission);
    let mut open = Vec::new();
    for part in [2, 8, 4, 5] {
        let cut = CancellationToken::new();
        let connection = connections.open(None, cut.clone()).await.unwrap();
        let backlog = Arc::clone(connection.activity().backlog());
        let stream = backlog.open::<Infallible>();
        assert!(backlog.note_read(part * budget / 20));
        open.push((connection, backlog, stream, cut));
    }
    let cut = |open: &[(Open, _, _, CancellationToken)]| {
        let cut = open.iter().map(|(.., cut)| cut.is_cancelled());
        cut.collect::<Vec<_>>()
    };
    // None stands as long as all have just begun.
    assert!(!open[0].1.note_read(budget / 4));
    let activity = open[0].0.activity().clone();
    // Only the client of the last one reads its answers.
    let unread = open[..3].iter().map(|open| open.0.activity().send(1));
    let _unread: Vec<_> = unread.collect();
    activity.cut_longest_backlog();
    assert_eq!(cut(&open), [false; 4]);
    advance(STANDING_TIME).await;
    let context = &mut Context::from_waker(Waker::noop());
    let mut more = Full::new(Bytes::from_static(b"more"));
    // The longest one is read.
    assert!(open[1].2.poll(context, &mut more).is_ready());
    for _ in 0..2 {
        // While it leaves, no other one is cut.
        activity.cut_longest_backlog();
        assert_eq!(cut(&open), [true, false, false, false]);
        advance(LOOK_INTERVAL).await;
    }
    drop(open.remove(0));
    advance(MAX_STANDING_TIME).await;
    activity.cut_longest_backlog();
    assert_eq!(cut(&open), [false, false, true]);
}

/// All clients read an answer every second. The second one reads what waits for it within the time, and the third one sends
/// the rest of its request.
#[tokio::test(start_paused = true)]
async fn the_connection_with_the_most_late_bytes_goes_while_bytes_are_short() {
    const MOST: Duration = Duration::from_secs(60);
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let max = admission.bytes().1 as usize;
    let (tenth, little) = (max / 10, admission.little());
    let connections = Connections::new(5, 1, admission);
    let mut open = Vec::new();
    for bytes in [2 * tenth, 3 * tenth, tenth, 2 * tenth, little] {
        let cut = CancellationToken::new();
        let connection = connections.open(None, cut.clone()).await.unwrap();
        let held = connection.activity().flow().hold();
        held.force_take(bytes);
        open.push((connection, held, cut));
    }
    let activities: Vec<_> = open.iter().map(|it| it.0.activity().clone()).collect();
    let _half_sent = [0, 2].map(|at| activities[at].wait(2 * tenth / (at + 1)));
    let unread = [(1, 3 * tenth), (3, 2 * tenth), (4, little)];
    let _unread = unread.map(|(at, bytes)| activities[at].send(bytes));
    let mut looking = pin!(connections.cut_waiting(MOST));
    let mut cut_after = async |seconds: u64, open: &[(Open, HeldBytes, CancellationToken)]| {
        for _ in 0..seconds {
            assert!(poll!(looking.as_mut()).is_pending());
            for activity in &activities {
                drop(activity.send(1));
            }
            activities[1].note_departure(3 * tenth / MOST.as_secs() as usize + 1);
            activities[2].note_arrival(tenth / MOST.as_secs() as usize + 1);
            advance(WAIT_LOOK_INTERVAL).await;
        }
        let cut = open.iter().map(|(.., cut)| cut.is_cancelled());
        cut.collect::<Vec<_>>()
    };
    let standing = MAX_STANDING_TIME.as_secs();
    assert_eq!(cut_after(2 * standing, &open).await, [false; 5]);
    assert_eq!(
        cut_after(1, &open).await,
        [true, false, false, false, false]
    );
    let cut = cut_after(10 * standing, &open).await;
    assert_eq!(cut, [true, false, false, true, false]);
}

#[tokio::test(start_paused = true)]
async fn no_connection_is_late_while_others_have_room() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let max = admission.bytes().1 as usize;
    let connections = Connections::new(1, 1, admission);
    let cut = CancellationToken::new();
    let connection = connections.open(None, cut.clone()).await.unwrap();
    let held = connection.activity().flow().hold();
    held.force_take(max / 4);
    let _half_sent = connection.activity().wait(max / 4);
    let looking = connections.cut_waiting(6 * MAX_STANDING_TIME);
    let looking = timeout(20 * MAX_STANDING_TIME, looking);
    assert!(looking.await.is_err() && !cut.is_cancelled());
}

#[tokio::test(start_paused = true)]
async fn a_connection_whose_client_reads_nothing_goes_after_its_time() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(2, 1, admission);
    let cuts = [CancellationToken::new(), CancellationToken::new()];
    let first = connections.open(None, cuts[0].clone()).await.unwrap();
    let _idle = connections.open(None, cuts[1].clone()).await.unwrap();
    let unread = [first.activity().send(1), first.activity().send(1)];
    let most = 6 * MAX_STANDING_TIME;
    let mut looking = pin!(connections.cut_waiting(most));
    let mut is_cut = async |time: Duration| {
        advance(time).await;
        assert!(poll!(looking.as_mut()).is_pending());
        cuts.each_ref().map(CancellationToken::is_cancelled)
    };
    assert_eq!(is_cut(most).await, [false, false]);
    let [read, _unread] = unread;
    drop(read);
    assert_eq!(is_cut(most).await, [false, false]);
    assert_eq!(is_cut(WAIT_LOOK_INTERVAL).await, [true, false]);
}

#[tokio::test(start_paused = true)]
async fn a_network_with_one_connection_makes_no_room() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(2, 1, admission);
    let mut open = Vec::new();
    for peer in ["192.0.2.1:1", "192.0.2.2:1"] {
        let cut = CancellationToken::new();
        let place = connections
            .open(peer.parse().ok(), cut.clone())
            .await
            .unwrap();
        let call = place.activity().begin();
        open.push((place, call, cut));
    }
    let newcomer = connections.open("192.0.2.3:1".parse().ok(), CancellationToken::new());
    assert!(is_guest(newcomer.await.as_ref()));
    assert!(open.iter().all(|(.., cut)| !cut.is_cancelled()));
}

#[tokio::test(start_paused = true)]
async fn a_connection_that_does_not_read_its_answer_makes_room_only_after_its_time() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let connections = Connections::new(1, 1, admission);
    let cut = CancellationToken::new();
    let first = connections.open(None, cut.clone()).await.unwrap();
    first.activity().set_stalled(true);
    let second = connections.open(None, CancellationToken::new()).await;
    while first.activity().silence() < MAX_SILENCE {
        assert!(is_guest(second.as_ref()));
        assert!(!cut.is_cancelled());
        advance(MAX_SILENCE / 10).await;
    }
    assert!(is_guest(second.as_ref()));
    assert!(cut.is_cancelled());
}
