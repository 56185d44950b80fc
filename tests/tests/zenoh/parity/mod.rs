//! One script of good and bad operations runs through the service, gRPC, Zenoh with Protocol Buffers and Zenoh with
//! JSON. The answers agree to the bit and the refusals to the word.

mod by_hand;
mod json;
mod op;
mod outcome;
mod scaling;
mod script;
mod sessions;
mod target;

use op::Op;
use outcome::Outcome;
use script::Script;
use target::Target;

const SEED: u64 = 20;
const RANDOM: usize = 480;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_faces_answer_alike() {
    println!("seed {SEED}");
    let mut recorded: Vec<(Op, Outcome)> = Vec::new();
    let mut service = Target::service();
    let mut script = Script::new(SEED, RANDOM);
    while let Some(op) = script.next() {
        let outcome = service.perform(&op).await;
        script.learn(&outcome);
        recorded.push((op, outcome));
    }
    let good = recorded.iter().filter(|(_, it)| it.is_ok()).count();
    let bad = recorded.len() - good;
    assert!(good > 200 && bad > 100, "{good} good, {bad} bad");
    let scaled = recorded.iter().filter(|(op, _)| scaling::is_scaled(op));
    let (good, bad): (Vec<_>, Vec<_>) = scaled.partition(|(_, outcome)| outcome.is_ok());
    let (good, bad) = (good.len(), bad.len());
    assert!(good > 20 && bad > 20, "{good} good, {bad} bad");
    let mut reasons: Vec<String> = recorded.iter().filter_map(|(_, it)| it.reason()).collect();
    reasons.sort();
    reasons.dedup();
    assert!(reasons.len() >= 20, "{reasons:?}");

    let mut said: Vec<Vec<Outcome>> = Vec::new();
    let [grpc, protobuf, json] = Target::faces().await;
    for mut target in [grpc, protobuf, json] {
        let mut outcomes = Vec::new();
        for (at, (op, expected)) in recorded.iter().enumerate() {
            // Over gRPC, a watch takes the place of the log.
            if !target.has(op) {
                outcomes.push(expected.clone());
                continue;
            }
            let outcome = target.perform(op).await;
            let name = target.name();
            assert_eq!(outcome.core(), expected.core(), "{name}, {at}: {op:?}");
            outcomes.push(outcome);
        }
        said.push(outcomes);
    }
    // A status adds a message and all details to the service's error; these are the same on each interface.
    for (at, (op, _)) in recorded.iter().enumerate() {
        assert_eq!(said[1][at], said[2][at], "{at}: {op:?}");
        if !matches!(op, Op::Log(_)) {
            assert_eq!(said[0][at], said[1][at], "{at}: {op:?}");
        }
    }
}
