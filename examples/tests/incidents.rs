//! Processes build one roadmap or the same two trees together, and a worker or the server is killed meanwhile. The
//! roadmap is the same as without the kill, and the trees stay trees.
//!
//! This program starts itself as the workers and as the server, so it has a `main` of its own.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::{
    collections::BTreeSet,
    env,
    io::{self, BufRead, BufReader},
    process::{Command, ExitCode, Stdio},
    sync::{LazyLock, mpsc},
    thread,
    time::Duration,
};

use clap::Parser;
use libtest_mimic::{Arguments, Trial};
use tokio::runtime::{Builder, Runtime};
use wayfold::{Client, IndexHandle};
use wayfold_examples::{
    maze::scene::Maze,
    planning::{
        options as trees_options, path,
        problem::Problem,
        processes::{Incident, PROGRESS_MS, run},
        server::{self, ServerProcess},
        shared_trees::{job, solve, store::Store},
    },
    rigid::{
        options::{Job, Options, ProcessCommand, Source},
        processes, replay,
        roadmap::Roadmap,
        scene::Rooms,
        worker::Worker,
    },
};

static SCENE: LazyLock<Rooms> = LazyLock::new(Rooms::new);
static MAZE: LazyLock<Maze> = LazyLock::new(|| Maze::between((0, 0), (4, 2)));
const MILESTONES: u64 = 150;
/// The number of a worker's milestones at which the incident happens.
const HALF: u64 = 20;

fn main() -> ExitCode {
    if let Some(ended) = server::serve_if_requested() {
        return ended;
    }
    match env::args().nth(1).as_deref() {
        Some("work") => {
            let Some(ProcessCommand::Work { job }) = Options::parse().role else {
                panic!("a worker has a job");
            };
            runtime().block_on(processes::work(&job)).unwrap();
            return ExitCode::SUCCESS;
        }
        Some("grow") => {
            let Some(trees_options::ProcessCommand::Grow { job }) =
                trees_options::Options::parse().role
            else {
                panic!("a worker has a job");
            };
            job::grow(&*MAZE, &job).unwrap();
            return ExitCode::SUCCESS;
        }
        Some("hold") => {
            let server = ServerProcess::start().unwrap();
            println!("{}", server.uri());
            // The worker runs until it is killed.
            io::copy(&mut io::stdin().lock(), &mut io::sink()).unwrap();
            return ExitCode::SUCCESS;
        }
        _ => {}
    }
    let trial = |name, test: fn()| {
        Trial::test(name, move || {
            test();
            Ok(())
        })
    };
    let trials = vec![
        trial(
            "a_killed_worker_changes_nothing_but_speed",
            a_killed_worker_changes_nothing_but_speed,
        ),
        trial(
            "a_killed_server_costs_a_pause_and_nothing_else",
            a_killed_server_costs_a_pause_and_nothing_else,
        ),
        trial(
            "a_killed_worker_leaves_trees_on_which_the_others_meet",
            a_killed_worker_leaves_trees_on_which_the_others_meet,
        ),
        trial(
            "a_server_ends_when_its_parent_is_killed",
            a_server_ends_when_its_parent_is_killed,
        ),
    ];
    libtest_mimic::run(&Arguments::from_args(), trials).exit_code()
}

fn runtime() -> Runtime {
    let mut runtime = Builder::new_multi_thread();
    runtime.worker_threads(1).enable_all().build().unwrap()
}

/// Three workers build a roadmap. One halts after some milestones.
fn jobs(server: &str, max_pending: usize) -> Vec<Job> {
    let job = |number| Job {
        server: server.to_owned(),
        index: "roadmap".to_owned(),
        number,
        seed: 11,
        milestones: MILESTONES,
        source: [Source::Shared, Source::Remote][number % 2],
        max_pending,
        min_separation: 0.0,
        progress_ms: PROGRESS_MS,
        halt_at: (number == 0).then_some(HALF),
    };
    (0..3).map(job).collect()
}

async fn index(server: &str) -> IndexHandle {
    let client = Client::connect(server).await.unwrap();
    let created = client.create_index("roadmap", SCENE.space()).await;
    created.unwrap()
}

/// The roadmap as stored, and after its completion.
async fn read(uri: &str, index: &IndexHandle) -> [Roadmap; 2] {
    index.info().await.unwrap();
    let as_left = Roadmap::read(index).await.unwrap();
    let heir = Worker::open(&SCENE, (uri, "roadmap"), Source::Remote, 3, 11);
    heir.await.unwrap().adopt(None).await.unwrap();
    [as_left, Roadmap::read(index).await.unwrap()]
}

/// Asserts that a single worker would have built the same roadmap, and that no state is stored twice.
fn is_serial(roadmap: &Roadmap) {
    assert!(roadmap.len() as u64 >= MILESTONES && !roadmap.pending.contains(&true));
    assert_eq!(replay::stored(roadmap), replay::edges(&SCENE, roadmap));
    let states = roadmap.states.iter();
    let states = states.map(|state| state.iter().map(|x| x.to_bits()).collect::<Vec<_>>());
    assert_eq!(states.collect::<BTreeSet<_>>().len(), roadmap.len());
}

fn a_killed_worker_changes_nothing_but_speed() {
    let server = ServerProcess::start().unwrap();
    let runtime = runtime();
    let index = runtime.block_on(index(server.uri()));
    let workers_report = run(&jobs(server.uri(), 4), Incident::WorkerKilled).unwrap();
    assert!(workers_report.killed.is_some_and(|(worker, _)| worker == 0));

    let [as_left, roadmap] = runtime.block_on(read(server.uri(), &index));
    let of_the_dead = as_left.workers.iter().filter(|&&worker| worker == 0);
    let of_the_dead = of_the_dead.count() as u64;
    assert!((HALF..MILESTONES / 2).contains(&of_the_dead));
    // Only the killed worker left milestones pending: those without a known place in the order, and as many whose
    // completion was under way.
    let pending = (0..as_left.len()).filter(|&at| as_left.pending[at]);
    let pending: Vec<usize> = pending.collect();
    assert!(pending.len() <= 8);
    assert!(pending.iter().all(|&at| as_left.workers[at] == 0));
    is_serial(&roadmap);
}

fn a_killed_server_costs_a_pause_and_nothing_else() {
    let mut server = ServerProcess::start().unwrap();
    let (runtime, uri) = (runtime(), server.uri().to_owned());
    let index = runtime.block_on(index(&uri));
    let workers_report = run(&jobs(&uri, 3), Incident::ServerRestarted(&mut server)).unwrap();
    let (killed, listened) = workers_report.restarted.unwrap();
    assert!(killed < listened);

    let [as_left, roadmap] = runtime.block_on(read(&uri, &index));
    assert!(!as_left.pending.contains(&true), "all workers have lived");
    is_serial(&roadmap);
}

fn a_killed_worker_leaves_trees_on_which_the_others_meet() {
    let server = ServerProcess::start().unwrap();
    let runtime = runtime();
    let store = runtime.block_on(async {
        let client = Client::connect(server.uri()).await.unwrap();
        Store::create(&client, "trees", &*MAZE).await.unwrap()
    });
    let job = |number| job::Job {
        server: server.uri().to_owned(),
        store: "trees".to_owned(),
        number,
        seed: 5,
        max_vertices: 100_000,
        source: [Source::Shared, Source::Remote][number % 2],
        progress_ms: PROGRESS_MS,
        halt_at: (number == 2).then_some(HALF),
    };
    let jobs: Vec<job::Job> = (0..3).map(job).collect();
    let workers_report = run(&jobs, Incident::WorkerKilled).unwrap();
    assert!(workers_report.killed.is_some_and(|(worker, _)| worker == 2));

    let (shared, path) = runtime.block_on(solve::read(&store)).unwrap();
    path::verify(&*MAZE, &path).unwrap();
    let of = |worker| {
        shared
            .makers
            .iter()
            .flatten()
            .filter(move |&&maker| maker == worker)
    };
    // The killed worker may have reported an insert under way that never took effect; no other worker's vertex is
    // missing.
    assert!(of(2).count() as u64 <= workers_report.accounts[2].vertices);
    let others: u64 = workers_report.accounts[..2]
        .iter()
        .map(|one| one.vertices)
        .sum();
    assert_eq!(
        (of(0).count() + of(1).count()) as u64,
        others + 2,
        "and the roots"
    );
}

fn a_server_ends_when_its_parent_is_killed() {
    let mut holder = Command::new(env::current_exe().unwrap())
        .arg("hold")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut uri = String::new();
    let mut output = BufReader::new(holder.stdout.take().unwrap());
    output.read_line(&mut uri).unwrap();
    let runtime = runtime();
    runtime.block_on(Client::connect(uri.trim())).unwrap();
    holder.kill().unwrap();
    holder.wait().unwrap();

    // The server inherited the standard error, which ends with the last process that holds it.
    let mut errors = holder.stderr.take().unwrap();
    let (ended, end) = mpsc::channel();
    thread::spawn(move || ended.send(io::copy(&mut errors, &mut io::sink())));
    end.recv_timeout(Duration::from_secs(60)).unwrap().unwrap();
    assert!(runtime.block_on(Client::connect(uri.trim())).is_err());
}
