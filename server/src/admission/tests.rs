use std::pin::pin;

use futures_util::poll;

use super::*;
use crate::config::Config;

#[test]
fn refusals_of_calls_of_administration_count() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let flow = admission.open();
    assert!(!flow.hold().take(usize::MAX));
    assert!(!flow.admin().hold().take(usize::MAX));
    assert_eq!(admission.refused(0)[1], ("TOO_MANY_BYTES", 2));
}

#[test]
fn refusals_for_unread_answers_count() {
    let admission = Admission::new(&Config::default().admission, 1, 0);
    let unread = admission.open().hold();
    unread.force_take(admission.all.max() + 1);
    assert!(!admission.open().hold().check_room(0));
    assert_eq!(admission.refused(0)[1], ("TOO_MANY_BYTES", 1));
}

/// Others hold more than the half of all bytes that a flow with several large requests may take.
#[test]
fn the_pieces_of_a_large_request_do_not_make_its_flow_greedy() {
    const MIB: usize = 1024 * 1024;
    let config = AdmissionConfig {
        max_bytes: 64 * MIB,
        ..Config::default().admission
    };
    let admission = Admission::new(&config, 1, 0);
    let (others, flow) = (admission.open().hold(), admission.open());
    others.force_take(40 * MIB);
    let call = flow.hold();
    for _ in 0..64 {
        assert!(call.take(MIB / 16));
    }
    assert!(call.check_room(0));
    let second = flow.hold();
    assert!(!second.take(MIB) && !second.check_room(0));
    drop(call);
    assert!(second.take(MIB));
    // An eighth is for flows that hold little.
    others.force_take(16 * MIB);
    assert!(!second.take(MIB));
}

#[tokio::test]
async fn calls_of_administration_wait_as_long_as_they_must() {
    let config = AdmissionConfig {
        queue_target_ms: 0,
        burst_ms: 0,
        ..Config::default().admission
    };
    let admission = Admission::new(&config, 1, 0);
    let flow = admission.open();
    let mut busy = flow.turns();
    busy.request().unwrap();
    let admin = flow.admin();
    let (mut other, mut list, mut create) = (flow.turns(), admin.turns(), admin.turns());
    let mut other = pin!(other.run(async {}));
    let (mut list, mut create) = (pin!(list.run(async {})), pin!(create.run(async {})));
    assert!(poll!(other.as_mut()).is_pending());
    assert!(poll!(list.as_mut()).is_pending() && poll!(create.as_mut()).is_pending());
    drop(busy);
    assert!(other.await.is_err());
    // The first that came goes first.
    assert!(poll!(create.as_mut()).is_pending());
    list.await.unwrap();
    create.await.unwrap();
}

#[test]
fn a_flow_whose_last_call_has_a_short_deadline_is_hurried() {
    let flow = Admission::new(&Config::default().admission, 1, 0).open();
    for (time, is_hurried) in [
        (Some(SHORT_TIME), true),
        (Some(SHORT_TIME + Duration::from_nanos(1)), false),
        (Some(Duration::ZERO), true),
        (None, false),
    ] {
        flow.note_time(time);
        assert_eq!(flow.is_hurried(), is_hurried, "{time:?}");
    }
}
