use std::time::{Duration, SystemTime};

use wayfold::Error;

use super::*;
use crate::load::{
    machine::Machine,
    mix::Verb,
    outcome::{PhaseOutcome, PointCounts, Step},
    record::Tally,
    settings::{Address, Face, PhaseSettings},
    states::Range,
};

/// A run whose names, all from outside, are markup.
fn outcome(calls: u64) -> Outcome {
    let mut tally = Tally::default();
    for call in 0..calls {
        let latency = Duration::from_micros(100 + call);
        tally.record(Verb::Knn, 1, latency, None);
    }
    let failure = Error::Connection {
        call: "knn",
        uri: "<script>1</script>".into(),
        source: "a & b".into(),
    };
    tally.record(Verb::Get, 1, Duration::ZERO, Some(&failure));
    let second = Duration::from_secs(1);
    Outcome {
        index: "<script>2</script>".into(),
        space: "R3".into(),
        address: Address {
            face: Face::Grpc,
            server: "\"><script>3</script>".into(),
            prefix: None,
            credentials: Default::default(),
            zenoh_tls: Default::default(),
        },
        server: None,
        machine: Machine {
            processor: "<script>4</script>".into(),
            processors: 2,
            memory_bytes: None,
            system: "linux".into(),
        },
        started: SystemTime::UNIX_EPOCH,
        seed: 1,
        range: Range::default(),
        timeout: second,
        tag: 1,
        warmup: None,
        steps: (0..2)
            .map(|phase| Step::of(&tally, phase, phase as u32 * second, second))
            .collect(),
        phases: (0..2)
            .map(|phase| PhaseOutcome {
                phase: PhaseSettings::default().phase("<script>5</script>"),
                tally: tally.clone(),
                start: phase * second,
                elapsed: second,
                due: Some(9_000_000),
            })
            .collect(),
        points: PointCounts::default(),
        flush: Duration::ZERO,
        is_interrupted: true,
    }
}

#[test]
fn nothing_from_outside_is_markup() {
    let page = page(&outcome(1000));
    assert!(!page.contains("<script"), "{page}");
    for part in [
        "&lt;script&gt;1",
        "&lt;script&gt;2",
        "&lt;script&gt;3",
        "&lt;script&gt;4",
        "a &amp; b",
    ] {
        assert!(page.contains(part), "no {part}");
    }
    assert!(page.contains("A signal ended the run early"));
    assert!(page.contains("due calls never began"));
}

#[test]
fn every_element_is_closed_and_every_number_is_one() {
    for calls in [0, 1, 1000] {
        let page = page(&outcome(calls));
        for element in [
            "svg", "section", "table", "tr", "td", "dl", "div", "span", "title", "ul", "main",
        ] {
            let opened = page.matches(&format!("<{element}>")).count()
                + page.matches(&format!("<{element} ")).count();
            assert_eq!(
                opened,
                page.matches(&format!("</{element}>")).count(),
                "{element}"
            );
        }
        for wrong in ["NaN", "inf\"", "infinity"] {
            assert!(!page.contains(wrong), "{calls} calls: {wrong}");
        }
    }
    let empty = Outcome {
        phases: Vec::new(),
        steps: Vec::new(),
        ..outcome(0)
    };
    assert!(page(&empty).contains("No call was made"));
}
