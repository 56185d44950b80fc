//! Workers as processes: instances of this program. Arguments select the role, and a worker reports its progress as
//! lines of JSON on its output.

use std::{
    env, fs,
    io::{self, BufRead, BufReader, Write},
    ops::Add,
    process::{Child, ChildStdin, Command, Stdio},
    sync::mpsc,
    thread,
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::{error::PlanningError, server::ServerProcess};

/// The job of a process, which gets it in JSON.
pub trait Job: Serialize {
    /// The type of its reports.
    type Account: Account;

    /// The subcommand that selects it.
    const ROLE: &'static str;

    /// The number of the worker.
    fn number(&self) -> usize;
}

/// The account of a worker.
pub trait Account: Copy + Default + Serialize + DeserializeOwned + Send + 'static {
    /// The number of milestones or vertices it has made.
    fn made(&self) -> u64;

    /// The account of its time.
    fn times(&self) -> Times;
}

/// The account of a worker's time.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Times {
    /// The total time; of two trees, without the wait for acknowledgements at the end.
    pub total: Duration,
    /// The time of searches for neighbours.
    pub searching: Duration,
    /// The time of computing states and checking them for collisions.
    pub checking: Duration,
    /// The time of inserts and updates.
    pub waiting: Duration,
}

impl Times {
    /// The share of a part, in percent.
    pub fn percent(&self, part: Duration) -> f64 {
        100.0 * part.as_secs_f64() / self.total.as_secs_f64().max(f64::MIN_POSITIVE)
    }
}

impl Add for Times {
    type Output = Times;

    fn add(self, other: Times) -> Times {
        Times {
            total: self.total + other.total,
            searching: self.searching + other.searching,
            checking: self.checking + other.checking,
            waiting: self.waiting + other.waiting,
        }
    }
}

/// The compared numbers of workers.
pub const WORKERS: [usize; 4] = [1, 2, 4, 8];

/// The interval of a worker's progress reports, for a picture.
pub const PROGRESS_MS: u64 = 20;

/// A message of a worker.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Line<A> {
    /// The worker is ready and waits for the line that starts all workers at once.
    Ready,
    /// Its account so far.
    Progress(A),
    /// Its account at its halt. It waits for a line.
    Halted(A),
    /// Its final account.
    Done(A),
}

/// The worker's end of the channel to its parent process.
pub struct Reporter {
    number: usize,
    every: Duration,
    last_report: Instant,
    halt: Option<u64>,
}

impl Reporter {
    /// Reports that the worker is ready, and waits for the start line. The worker reports its progress at most once per
    /// interval, given in milliseconds. Once it has made `halt_at` milestones or vertices, it reports so and waits for
    /// a line.
    pub fn ready<J: Job>(
        job: &J,
        every_ms: u64,
        halt_at: Option<u64>,
    ) -> Result<Reporter, PlanningError> {
        tell(job.number(), &Line::<J::Account>::Ready)?;
        let reporter = Reporter {
            number: job.number(),
            every: Duration::from_millis(every_ms),
            last_report: Instant::now(),
            halt: halt_at,
        };
        reporter.wait()?;
        Ok(reporter)
    }

    /// Reports the worker's account so far, if a report is due.
    pub fn progress(&mut self, account: &impl Account) -> Result<(), PlanningError> {
        if self.halt.is_some_and(|own| account.made() >= own) {
            self.halt = None;
            tell(self.number, &Line::Halted(*account))?;
            return self.wait();
        }
        if self.last_report.elapsed() < self.every {
            return Ok(());
        }
        self.last_report = Instant::now();
        tell(self.number, &Line::Progress(*account))
    }

    /// Reports the worker's final account.
    pub fn done(self, account: &impl Account) -> Result<(), PlanningError> {
        tell(self.number, &Line::Done(*account))
    }

    /// Waits for a line; fails if the input is closed.
    fn wait(&self) -> Result<(), PlanningError> {
        let mut line = String::new();
        let read = io::stdin().lock().read_line(&mut line);
        match read.map_err(|problem| lost(self.number, problem))? {
            0 => Err(lost(self.number, "its parent process has ended")),
            _ => Ok(()),
        }
    }
}

/// Writes a message. It fails if the reader is gone, which ends a worker whose parent has ended.
fn tell<A: Account>(number: usize, line: &Line<A>) -> Result<(), PlanningError> {
    let mut output = io::stdout().lock();
    let written = serde_json::to_writer(&mut output, line).map_err(io::Error::from);
    let written = written.and_then(|()| output.write_all(b"\n"));
    let written = written.and_then(|()| output.flush());
    written.map_err(|problem| lost(number, problem))
}

/// The error of a worker.
pub fn lost(number: usize, problem: impl ToString) -> PlanningError {
    PlanningError::Worker {
        number,
        problem: problem.to_string(),
    }
}

/// The accounts of the workers, and their progress.
pub struct WorkersReport<A> {
    /// The final account of each worker; for a killed worker, its last report.
    pub accounts: Vec<A>,
    /// The time from the common start to the end of the last worker, whose writes were acknowledged then.
    pub wall: Duration,
    /// The part of the machine's processor time that all processes spent until then; `None` if the system does not tell.
    pub busy_share: Option<f64>,
    /// The progress reports with their times.
    pub growth: Vec<WorkerProgress>,
    /// The killed worker, and the time.
    pub killed: Option<(usize, Duration)>,
    /// The times at which the server was killed and at which it listened again.
    pub restarted: Option<(Duration, Duration)>,
}

impl<A: Account> WorkersReport<A> {
    /// The time at which the last worker's account ends.
    pub fn end(&self) -> Duration {
        let ends = self.accounts.iter().map(|account| account.times().total);
        ends.max().unwrap_or_default()
    }

    /// The longest time without a report of progress from any worker.
    pub fn longest_pause(&self) -> Duration {
        let mut events: Vec<Duration> = self.growth.iter().map(|events| events.at).collect();
        events.sort_unstable();
        let pauses = events.windows(2).map(|pair| pair[1] - pair[0]);
        pauses.max().unwrap_or_default()
    }
}

/// The incident at a worker's halt.
pub enum Incident<'a> {
    /// No incident: it continues.
    None,
    /// It is killed.
    WorkerKilled,
    /// This server is killed and restarted while the worker continues.
    ServerRestarted(&'a mut ServerProcess),
}

/// A worker's progress.
#[derive(Clone, Copy, Debug)]
pub struct WorkerProgress {
    /// The time since the common start.
    pub at: Duration,
    /// The number of the worker.
    pub worker: usize,
    /// The number of milestones or vertices it had made.
    pub made: u64,
}

/// Runs these jobs concurrently to their end, with an incident whenever a worker halts.
pub fn run<J: Job>(
    jobs: &[J],
    mut incident: Incident<'_>,
) -> Result<WorkersReport<J::Account>, PlanningError> {
    let (events, lines) = mpsc::channel();
    let mut processes = start(jobs, move |event| events.send(event).is_ok())?;
    let (started, before) = (Instant::now(), Ticks::now());
    for process in &mut processes {
        process.begin()?;
    }
    let mut workers_report = WorkersReport {
        accounts: vec![J::Account::default(); jobs.len()],
        wall: Duration::ZERO,
        busy_share: None,
        growth: Vec::new(),
        killed: None,
        restarted: None,
    };
    let mut done = vec![false; jobs.len()];
    let mut working = jobs.len();
    while working > 0 {
        let none = |_| lost(0, "all workers have ended early; what they said is above");
        let (number, line, when) = lines.recv().map_err(none)?;
        let at = when.saturating_duration_since(started);
        let was_killed = workers_report
            .killed
            .is_some_and(|(killed, _)| killed == number);
        let account = match line {
            Some(Line::Progress(account)) => account,
            Some(Line::Halted(account)) => {
                match &mut incident {
                    Incident::None => processes[number].begin()?,
                    Incident::WorkerKilled => {
                        processes[number].kill()?;
                        workers_report.killed = Some((number, at));
                    }
                    Incident::ServerRestarted(server) => {
                        server.kill()?;
                        processes[number].begin()?;
                        server.start_again()?;
                        workers_report.restarted = Some((at, started.elapsed()));
                    }
                }
                account
            }
            Some(Line::Done(account)) => {
                done[number] = true;
                account
            }
            Some(Line::Ready) => continue,
            None if done[number] || was_killed => {
                working -= 1;
                continue;
            }
            None => return Err(lost(number, "it ended early; what it said is above")),
        };
        workers_report.wall = at;
        workers_report.busy_share = Ticks::share_since(before);
        workers_report.accounts[number] = account;
        workers_report.growth.push(WorkerProgress {
            at,
            worker: number,
            made: account.made(),
        });
    }
    Ok(workers_report)
}

/// The processor time of the machine since its start, in ticks.
#[derive(Clone, Copy)]
struct Ticks {
    all: u64,
    idle: u64,
}

impl Ticks {
    /// None if the system does not tell: only Linux does.
    fn now() -> Option<Ticks> {
        // The times: user, nice, system, idle, waiting for a disk, interrupts, soft interrupts, stolen.
        let stat = fs::read_to_string("/proc/stat").ok()?;
        let numbers = stat.lines().next()?.split_whitespace().skip(1).take(8);
        let ticks: Vec<u64> = numbers.map_while(|number| number.parse().ok()).collect();
        Some(Ticks {
            all: ticks.iter().sum(),
            idle: ticks.get(3)? + ticks.get(4)?,
        })
    }

    /// The part of the time since `before` that was not idle.
    fn share_since(before: Option<Ticks>) -> Option<f64> {
        let (before, now) = (before?, Ticks::now()?);
        let all = now.all.saturating_sub(before.all).max(1);
        Some(1.0 - now.idle.saturating_sub(before.idle) as f64 / all as f64)
    }
}

/// A line of a worker, or its end, and the time of its arrival.
pub type WorkerEvent<A> = (usize, Option<Line<A>>, Instant);

/// Starts a worker for each job, and returns once all are ready, or with the first in order that ended before. Forwards
/// their messages as long as `events` accepts them.
pub fn start<J: Job>(
    jobs: &[J],
    events: impl Fn(WorkerEvent<J::Account>) -> bool + Clone + Send + 'static,
) -> Result<Vec<Process>, PlanningError> {
    let processes = jobs.iter().map(Process::start);
    let mut processes = processes.collect::<Result<Vec<_>, _>>()?;
    for process in &mut processes {
        process.listen(events.clone())?;
    }
    Ok(processes)
}

/// A worker; killed when it is dropped.
pub struct Process {
    number: usize,
    child: Child,
    input: Option<ChildStdin>,
}

impl Process {
    fn start<J: Job>(job: &J) -> Result<Process, PlanningError> {
        let number = job.number();
        let failed = |problem: io::Error| lost(number, problem);
        let program = env::current_exe().map_err(failed)?;
        let job = serde_json::to_string(job).map_err(|problem| failed(problem.into()))?;
        let mut child = Command::new(program)
            .args([J::ROLE, &job])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        Ok(Process {
            number,
            input: child.stdin.take(),
            child,
        })
    }

    /// Waits until it is ready, and then forwards its messages and its end.
    fn listen<A: Account>(
        &mut self,
        events: impl Fn(WorkerEvent<A>) -> bool + Send + 'static,
    ) -> Result<(), PlanningError> {
        let number = self.number;
        let output = self.child.stdout.take().map(BufReader::new).into_iter();
        let lines = output.flat_map(BufRead::lines).map_while(Result::ok);
        let mut lines = lines.filter_map(|line| serde_json::from_str::<Line<A>>(&line).ok());
        let Some(Line::Ready) = lines.next() else {
            return Err(lost(number, "it ended before it was ready"));
        };
        thread::spawn(move || {
            // The receiver is gone once the run is over.
            let mut lines = lines.map(Some).chain([None]);
            lines.all(|line| events((number, line, Instant::now())))
        });
        Ok(())
    }

    /// Starts its work.
    pub fn begin(&mut self) -> Result<(), PlanningError> {
        let mut input = self.input.iter_mut();
        let written = input.try_for_each(|input| input.write_all(b"go\n"));
        written.map_err(|problem| lost(self.number, problem))
    }

    fn kill(&mut self) -> Result<(), PlanningError> {
        let killed = self.child.kill();
        killed.map_err(|problem| lost(self.number, problem))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Both calls fail only if it has already ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
