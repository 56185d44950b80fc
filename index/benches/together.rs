//! The cost of concurrency: readers of one snapshot, parallel bulk inserts, a reader next to a writer, and the slowest
//! calls while levels merge.
//!
//!     cargo bench -p wayfold-index --bench together [-- [POINTS] [--json FILE]]
//!
//! In SE(3), `R3*SO3:0.15`, uniform, ten neighbours. Two threads of one process are compared with two processes, in
//! turns: no structure can give two threads more than the machine gives two processes. Each figure is the median of the
//! rounds.

use std::{
    env, fs,
    io::{self, BufRead, BufReader, Write},
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
    sync::{
        Barrier, Mutex,
        atomic::{AtomicUsize, Ordering::Relaxed},
        mpsc,
    },
    thread,
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_index::{
    Forest, ForestOptions, ForestSnapshot, Merge, Merged, PointRef, Points, Search, Space,
};

const WIDTH: usize = 7;
const K: usize = 10;
const SEED: u64 = 7;
/// The points that readers search, and those of a bulk insert.
const POINTS: usize = 50_000;
/// The default number of single inserts in the measurement of the slowest calls.
const LARGE_POINTS: usize = 1_000_000;
const ROUNDS: usize = 5;
const DURATION: Duration = Duration::from_secs(2);
/// The length of a turn: the writer rests in even turns and writes in odd ones.
const TURN: Duration = Duration::from_millis(100);
const TURNS: usize = 40;
/// The number of queries between two checks of the turn.
const QUERIES_PER_CHECK: usize = 16;
/// The number of distinct queries.
const QUERIES: usize = 4_096;
/// The work of a process that the measuring one has started.
const ROLE: &str = "TOGETHER_ROLE";

fn main() {
    match env::var(ROLE) {
        Ok(role) => serve_one_round(&role),
        Err(_) => measure(),
    }
}

fn measure() {
    let arguments: Vec<String> = env::args().collect();
    let points = arguments.iter().find_map(|argument| argument.parse().ok());
    let json = arguments.iter().position(|argument| argument == "--json");
    let json = json.map(|at| arguments.get(at + 1).expect("a file after --json"));
    println!("R3*SO3:0.15, uniform, k = {K}; medians of {ROUNDS} rounds");
    let mut parts = vec![format!("\"rounds\": {ROUNDS}")];
    for (what, role) in [
        ("readers of 50,000 points", "read"),
        ("bulk inserts of 50,000 points", "bulk"),
    ] {
        let mut rounds = Vec::new();
        for _ in 0..ROUNDS {
            let one = by_threads(role, 1);
            let threads = by_threads(role, 2);
            let processes = by_processes(role);
            rounds.push([one, threads / one, processes / one, threads / processes]);
        }
        let [one, threads, processes, ratio] = medians(&rounds);
        println!(
            "{what}: one does {one:.0}/s, two threads {threads:.2} times that, two processes {processes:.2}, ratio {ratio:.2}"
        );
        parts.push(format!(
            "\"{role}\": {{\"per_second\": {one}, \"threads\": {threads}, \"processes\": {processes}, \"ratio\": {ratio}}}"
        ));
    }
    let rounds: Vec<_> = (0..ROUNDS).map(|_| next_to_a_writer()).collect();
    let [alone, next_to_writer, ratio, inserts] = medians(&rounds);
    println!(
        "a reader next to a writer: {next_to_writer:.0}/s of {alone:.0}/s alone, ratio {ratio:.2}; {inserts:.0} inserts/s"
    );
    parts.push(format!(
        "\"beside_a_writer\": {{\"per_second\": {next_to_writer}, \"alone\": {alone}, \"ratio\": {ratio}, \"inserts_per_second\": {inserts}}}"
    ));
    parts.push(slowest(points.unwrap_or(LARGE_POINTS)));
    if let Some(file) = json {
        let text = format!("{{\n  {}\n}}\n", parts.join(",\n  "));
        fs::write(file, text).expect("a file that can be written");
    }
}

fn medians<const N: usize>(rounds: &[[f64; N]]) -> [f64; N] {
    std::array::from_fn(|at| {
        let mut values: Vec<f64> = rounds.iter().map(|round| round[at]).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    })
}

fn space() -> Space {
    "R3*SO3:0.15".parse().expect("a space")
}

/// Canonical rows.
fn states(rows: usize, seed: u64) -> Vec<f64> {
    let (space, mut rng) = (space(), ChaCha8Rng::seed_from_u64(seed));
    let mut states = Vec::with_capacity(rows * WIDTH);
    while states.len() < rows * WIDTH {
        let mut row: [f64; WIDTH] = std::array::from_fn(|at| match at {
            0..3 => rng.random(),
            _ => rng.random_range(-1.0..1.0),
        });
        let norm = row[3..].iter().map(|x| x * x).sum::<f64>().sqrt();
        if (0.1..=1.0).contains(&norm) {
            row[3..].iter_mut().for_each(|x| *x /= norm);
            space.canonicalize(&mut row).expect("a state");
            states.extend(row);
        }
    }
    states
}

fn table(states: &[f64], first: u64) -> Points {
    let mut points = Points::with_capacity(WIDTH, states.len() / WIDTH);
    for (row, id) in states.chunks(WIDTH).zip(first..) {
        points.push_point(PointRef {
            id,
            tag: 0,
            revision: id + 1,
            row,
        });
    }
    points
}

fn forest(states: &[f64]) -> Forest {
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    let points = table(states, 0);
    forest
        .apply(points.len() as u64, &points, &[])
        .expect("points and states of the space");
    forest.settle();
    forest
}

/// Work of one kind, with its data.
enum Workload {
    Read(ForestSnapshot, Vec<f64>),
    Bulk(Vec<f64>),
}

impl Workload {
    fn new(role: &str) -> Self {
        let stored = states(POINTS, SEED);
        match role {
            "bulk" => Workload::Bulk(stored),
            _ => Workload::Read(forest(&stored).snapshot(), states(QUERIES, SEED + 1)),
        }
    }

    /// The rate of the work, in units a second.
    fn rate(&self) -> f64 {
        let (started, mut done) = (Instant::now(), 0);
        while started.elapsed() < DURATION {
            match self {
                Workload::Read(points, queries) => {
                    queries.chunks(WIDTH).for_each(|row| query(points, row));
                    done += QUERIES;
                }
                Workload::Bulk(stored) => {
                    assert_eq!(forest(stored).len(), POINTS);
                    done += 1;
                }
            }
        }
        done as f64 / started.elapsed().as_secs_f64()
    }
}

fn query(points: &ForestSnapshot, row: &[f64]) {
    let answer = points
        .search(row, &Search::nearest_k(K))
        .expect("points and states of the space");
    assert_eq!(answer.neighbors.len(), K);
}

/// The sum of the rates of `count` threads.
fn by_threads(role: &str, count: usize) -> f64 {
    let (work, start) = (Workload::new(role), Barrier::new(count));
    thread::scope(|scope| {
        let one = || {
            start.wait();
            work.rate()
        };
        let threads: Vec<_> = (0..count).map(|_| scope.spawn(one)).collect();
        let rates = threads
            .into_iter()
            .map(|thread| thread.join().expect("no panic"));
        rates.sum()
    })
}

/// Another process that does the same work.
struct Worker {
    child: Child,
    stdin: ChildStdin,
    stdout: BufReader<ChildStdout>,
}

impl Worker {
    fn start(role: &str) -> Self {
        let mut child = Command::new(env::current_exe().expect("this program"))
            .env(ROLE, role)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a process");
        let (stdin, stdout) = (child.stdin.take(), child.stdout.take());
        let stdout = BufReader::new(stdout.expect("a pipe"));
        let mut worker = Self {
            child,
            stdin: stdin.expect("a pipe"),
            stdout,
        };
        assert_eq!(worker.line(), "ready");
        worker
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        self.stdout.read_line(&mut line).expect("a line");
        line.trim_end().to_owned()
    }
}

fn by_processes(role: &str) -> f64 {
    let mut workers = [Worker::start(role), Worker::start(role)];
    for worker in &mut workers {
        writeln!(worker.stdin, "go").expect("somebody who reads");
    }
    let mut rate = 0.0;
    for mut worker in workers {
        rate += worker.line().parse::<f64>().expect("a rate");
        worker.child.wait().expect("an end");
    }
    rate
}

fn serve_one_round(role: &str) {
    let work = Workload::new(role);
    println!("ready");
    io::stdin().read_line(&mut String::new()).expect("a line");
    println!("{}", work.rate());
}

/// The rate of a reader alone and next to a writer, which inserts single points as fast as it can and merges on its own
/// thread. Every query is of the newest snapshot. The writer rests and writes in turns, so that both rates are of
/// nearly the same points.
#[expect(clippy::disallowed_methods, reason = "the writer's rest")]
fn next_to_a_writer() -> [f64; 4] {
    let queries = states(QUERIES, SEED + 1);
    let mut forest = forest(&states(POINTS, SEED));
    let more = states(20 * POINTS, SEED + 2);
    let mut more = more.chunks(WIDTH).zip(POINTS as u64..);
    let published = Mutex::new(forest.snapshot());
    let turn = AtomicUsize::new(0);
    let read = || {
        let (mut done, mut taken) = ([0.0; 2], [0.0; 2]);
        let mut queries = queries.chunks(WIDTH).cycle();
        loop {
            let (now, started) = (turn.load(Relaxed), Instant::now());
            if now == TURNS {
                return [done[0] / taken[0], done[1] / taken[1]];
            }
            for row in queries.by_ref().take(QUERIES_PER_CHECK) {
                let points = published.lock().expect("no panic").clone();
                query(&points, row);
            }
            if turn.load(Relaxed) == now {
                done[now % 2] += QUERIES_PER_CHECK as f64;
                taken[now % 2] += started.elapsed().as_secs_f64();
            }
        }
    };
    thread::scope(|scope| {
        let reader = scope.spawn(read);
        let (mut inserted, mut writing) = (0.0, Duration::ZERO);
        for now in 0..TURNS {
            turn.store(now, Relaxed);
            let started = Instant::now();
            if now % 2 == 0 {
                thread::sleep(TURN);
                continue;
            }
            while started.elapsed() < TURN {
                let (row, id) = more.next().expect("rows enough");
                forest
                    .apply(id + 1, &table(row, id), &[])
                    .expect("points and states of the space");
                forest.settle();
                let snapshot = forest.snapshot();
                let mut published = published.lock().expect("no panic");
                let replaced = std::mem::replace(&mut *published, snapshot);
                // The replaced snapshot is freed outside the lock.
                drop(published);
                drop(replaced);
                inserted += 1.0;
            }
            writing += started.elapsed();
        }
        turn.store(TURNS, Relaxed);
        let [alone, next_to_writer] = reader.join().expect("no panic");
        let inserts = inserted / writing.as_secs_f64();
        [alone, next_to_writer, next_to_writer / alone, inserts]
    })
}

/// The slowest of `count` single inserts, and of queries made between them, while another thread merges. Returns them
/// as a part of the JSON.
fn slowest(count: usize) -> String {
    let (rows, query_rows) = (states(count, SEED), states(QUERIES, SEED + 1));
    let mut forest = Forest::new(space(), ForestOptions::for_space(&space()));
    let (mut inserts, mut queries) = (Vec::with_capacity(count), Vec::with_capacity(count / 10));
    thread::scope(|scope| {
        let (to_merge, due) = mpsc::channel::<Merge>();
        let (ran, merged) = mpsc::channel::<Merged>();
        scope.spawn(move || {
            for merge in due {
                // The receiver may be gone at the end.
                let _ = ran.send(merge.run());
            }
        });
        let mut merging = false;
        for (id, row) in rows.chunks(WIDTH).enumerate() {
            let point = table(row, id as u64);
            let started = Instant::now();
            if let Ok(merged) = merged.try_recv() {
                forest.finish_merge(merged);
                merging = false;
            }
            forest
                .apply(id as u64 + 1, &point, &[])
                .expect("points and states of the space");
            if !merging && let Some(merge) = forest.begin_merge() {
                to_merge.send(merge).expect("a merger");
                merging = true;
            }
            inserts.push(started.elapsed());
            if id >= K && id % 10 == 0 {
                let row = &query_rows[id / 10 % QUERIES * WIDTH..][..WIDTH];
                let started = Instant::now();
                query(&forest.snapshot(), row);
                queries.push(started.elapsed());
            }
        }
        drop(to_merge);
    });
    println!(
        "{count} single inserts, a query after every tenth, merges on another thread; microseconds:"
    );
    let mut json = format!("\"slowest\": {{\"points\": {count}");
    for (what, mut taken) in [("inserts", inserts), ("queries", queries)] {
        taken.sort();
        let quantile = |q: f64| {
            let at = ((taken.len() - 1) as f64 * q) as usize;
            taken[at].as_secs_f64() * 1e6
        };
        let [median, last, slowest] = [0.5, 0.999, 1.0].map(quantile);
        let over = taken
            .iter()
            .filter(|taken| taken.as_micros() > 1000)
            .count();
        println!(
            "  {what}: median {median:.1}, 99.9 % within {last:.0}, slowest {slowest:.0}, over 1 ms: {over}"
        );
        json.push_str(&format!(
            ", \"{what}\": {{\"p50_us\": {median}, \"p999_us\": {last}, \"max_us\": {slowest}, \"over_1_ms\": {over}}}"
        ));
    }
    json + "}"
}
