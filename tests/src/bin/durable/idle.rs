//! The cost of a thousand idle indices of one point each.

use std::{fs, time::Instant};

use wayfold_tests::{
    Signal, States, Stubs,
    figures::{median, resident_bytes},
    measuring,
    report::Report,
};

use crate::{
    SPACE,
    base_directory::{BaseDirectory, used},
    service::insertion,
};

const COUNTS: [usize; 3] = [0, 100, 1_000];
/// The number of starts of each.
const STARTS: usize = 5;

/// The cost of a server with some idle indices.
struct Idle {
    files: f64,
    bytes: f64,
    resident: f64,
    start_ms: f64,
}

pub(crate) async fn measure(base: &BaseDirectory, report: &mut Report) {
    report.section("idle indices of one point each", "");
    let mut none: Option<Idle> = None;
    for count in COUNTS {
        let idle = host(base, count).await;
        for (what, figure, unit, base) in [
            (
                "files",
                idle.files,
                "",
                none.as_ref().map(|none| none.files),
            ),
            (
                "on disk",
                idle.bytes,
                "bytes",
                none.as_ref().map(|none| none.bytes),
            ),
            (
                "resident after a start",
                idle.resident,
                "bytes",
                none.as_ref().map(|none| none.resident),
            ),
            (
                "start until ready",
                idle.start_ms,
                "ms",
                none.as_ref().map(|none| none.start_ms),
            ),
        ] {
            report.note(&format!("{count} indices: {what}"), figure, unit);
            if let Some(base) = base {
                let each = (figure - base) / count as f64;
                report.note(&format!("  each of {count}: {what}"), each, unit);
            }
        }
        none.get_or_insert(idle);
    }
}

async fn host(base: &BaseDirectory, count: usize) -> Idle {
    let directory = base.create();
    let data = directory.path().join("data");
    let data = data.to_string_lossy().into_owned();
    let server = measuring::server(&data);
    let mut stubs = Stubs::connect(server.uri()).await;
    let mut states = States::new(SPACE.parse().expect("a space"), 0);
    for number in 0..count {
        let name = format!("idle-{number}");
        stubs.create(&name, SPACE).await;
        let mut request = insertion(&states.row(), None);
        request.index_name = name;
        stubs.insert(request).await;
    }
    drop(stubs);
    let stopped = server.stop(Signal::Terminate);
    assert!(stopped.status.success(), "{}", stopped.stderr);
    let (bytes, files) = used(directory.path());
    let (mut starts, mut resident) = (Vec::new(), 0);
    for _ in 0..STARTS {
        let began = Instant::now();
        let server = measuring::server(&data);
        starts.push(began.elapsed().as_secs_f64() * 1e3);
        resident = resident_bytes(server.process().id()).unwrap_or_default();
        server.stop(Signal::Terminate);
    }
    fs::remove_dir_all(&data).expect("a directory of ours");
    Idle {
        files: files as f64,
        bytes: bytes as f64,
        resident: resident as f64,
        start_ms: median(starts),
    }
}
