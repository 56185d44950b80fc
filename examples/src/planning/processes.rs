//! Workers as processes: this program again, told its role by its arguments, and telling its progress on its output, a
//! line of JSON each time.

use std::{
    env,
    io::{self, BufRead, BufReader, Write},
    ops::Add,
    process::{Child, ChildStdin, Command, Stdio},
    sync::mpsc::{self, Receiver},
    thread,
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::{error::PlanningError, server::ServerProcess};

/// What a process is told to do.
pub trait Job {
    /// What it tells of its doings.
    type Account: Account;

    /// The subcommand that makes a process do it.
    const ROLE: &'static str;

    /// Which worker it is.
    fn number(&self) -> usize;

    /// The arguments behind the subcommand.
    fn arguments(&self) -> Vec<String>;
}

/// What a worker has done.
pub trait Account: Copy + Default + Serialize + DeserializeOwned + Send + 'static {
    /// How many milestones or vertices it has made.
    fn made(&self) -> u64;

    /// Where its time went.
    fn times(&self) -> Times;
}

/// Where a worker's time went.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Times {
    /// All of it.
    pub total: Duration,
    /// What went into searches for neighbours.
    pub searching: Duration,
    /// What went into states and whether they are free.
    pub checking: Duration,
    /// What went into waiting for mutations.
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

/// How often a worker tells its progress, for a picture of it.
pub const PROGRESS_MS: u64 = 20;

/// What a worker tells.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Line<A> {
    /// It waits for the line that lets all begin at once.
    Ready,
    /// What it has done so far.
    Progress(A),
    /// What it has done when it was to halt; it waits for a line.
    Halted(A),
    /// What it has done at the end.
    Done(A),
}

/// The worker's side: what it tells who started it.
pub struct Reporter {
    number: usize,
    every: Duration,
    told: Instant,
    halt: Option<u64>,
}

impl Reporter {
    /// Says that the worker is ready, and waits to be told to begin. It tells its progress at most once in so many
    /// milliseconds; once it has made `halt_at` of its own it says so, and waits to be told to go on.
    pub fn ready<J: Job>(
        job: &J,
        every_ms: u64,
        halt_at: Option<u64>,
    ) -> Result<Reporter, PlanningError> {
        tell(job.number(), &Line::<J::Account>::Ready)?;
        let reporter = Reporter {
            number: job.number(),
            every: Duration::from_millis(every_ms),
            told: Instant::now(),
            halt: halt_at,
        };
        reporter.wait()?;
        Ok(reporter)
    }

    /// Tells what the worker has done so far, if it is time to.
    pub fn progress(&mut self, account: &impl Account) -> Result<(), PlanningError> {
        if self.halt.is_some_and(|own| account.made() >= own) {
            self.halt = None;
            tell(self.number, &Line::Halted(*account))?;
            return self.wait();
        }
        if self.told.elapsed() < self.every {
            return Ok(());
        }
        self.told = Instant::now();
        tell(self.number, &Line::Progress(*account))
    }

    /// Tells what the worker has done in all.
    pub fn done(self, account: &impl Account) -> Result<(), PlanningError> {
        tell(self.number, &Line::Done(*account))
    }

    /// Waits for a line; fails where nobody can write one any more.
    fn wait(&self) -> Result<(), PlanningError> {
        let mut line = String::new();
        let read = io::stdin().lock().read_line(&mut line);
        match read.map_err(|problem| lost(self.number, problem))? {
            0 => Err(lost(self.number, "who started it is gone")),
            _ => Ok(()),
        }
    }
}

/// Fails where nobody listens any more, and so ends a worker whose parent is gone.
fn tell<A: Account>(number: usize, line: &Line<A>) -> Result<(), PlanningError> {
    let mut output = io::stdout().lock();
    let written = serde_json::to_writer(&mut output, line).map_err(io::Error::from);
    let written = written.and_then(|()| output.write_all(b"\n"));
    let written = written.and_then(|()| output.flush());
    written.map_err(|problem| lost(number, problem))
}

/// What happened to a worker.
pub fn lost(number: usize, problem: impl ToString) -> PlanningError {
    PlanningError::Worker {
        number,
        problem: problem.to_string(),
    }
}

/// What the workers have done, and how it grew.
pub struct Crew<A> {
    /// The account of each at its end; of one that was killed, the last it told.
    pub accounts: Vec<A>,
    /// From the start of all to the end of the last.
    pub wall: Duration,
    /// When each told how much it had made.
    pub growth: Vec<Told>,
    /// Which was killed, and when.
    pub killed: Option<(usize, Duration)>,
    /// When the server was killed, and when it listened again.
    pub restarted: Option<(Duration, Duration)>,
}

impl<A> Crew<A> {
    /// The longest time in which no worker told that it had made more.
    pub fn longest_pause(&self) -> Duration {
        let mut told: Vec<Duration> = self.growth.iter().map(|told| told.at).collect();
        told.sort_unstable();
        let pauses = told.windows(2).map(|pair| pair[1] - pair[0]);
        pauses.max().unwrap_or_default()
    }
}

/// What happens when a worker halts.
pub enum Incident<'a> {
    /// Nothing: it goes on.
    None,
    /// It is killed.
    WorkerKilled,
    /// This server is killed, and is started again while the worker goes on.
    ServerRestarted(&'a mut ServerProcess),
}

/// A worker's progress.
#[derive(Clone, Copy, Debug)]
pub struct Told {
    /// Since the start of all.
    pub at: Duration,
    /// Which worker.
    pub worker: usize,
    /// How many milestones or vertices it had made.
    pub made: u64,
}

/// Runs these jobs side by side, to their end, with an incident wherever a worker halts.
pub fn run<J: Job>(
    jobs: &[J],
    mut incident: Incident<'_>,
) -> Result<Crew<J::Account>, PlanningError> {
    let (told, lines) = mpsc::channel();
    let mut processes = Vec::with_capacity(jobs.len());
    for job in jobs {
        let told = told.clone();
        processes.push(Process::start(job, move |heard| told.send(heard).is_ok())?);
    }
    drop(told);
    for _ in jobs {
        match next(&lines)? {
            (_, Some(Line::Ready), _) => {}
            (number, ..) => return Err(lost(number, "it ended before it was ready")),
        }
    }
    let started = Instant::now();
    for process in &mut processes {
        process.begin()?;
    }
    let mut crew = Crew {
        accounts: vec![J::Account::default(); jobs.len()],
        wall: Duration::ZERO,
        growth: Vec::new(),
        killed: None,
        restarted: None,
    };
    let mut done = vec![false; jobs.len()];
    let mut working = jobs.len();
    while working > 0 {
        let (number, line, when) = next(&lines)?;
        let at = when.saturating_duration_since(started);
        let was_killed = crew.killed.is_some_and(|(killed, _)| killed == number);
        let account = match line {
            Some(Line::Progress(account)) => account,
            Some(Line::Halted(account)) => {
                match &mut incident {
                    Incident::None => processes[number].begin()?,
                    Incident::WorkerKilled => {
                        processes[number].kill()?;
                        crew.killed = Some((number, at));
                    }
                    Incident::ServerRestarted(server) => {
                        server.kill()?;
                        processes[number].begin()?;
                        server.start_again()?;
                        crew.restarted = Some((at, started.elapsed()));
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
        crew.wall = at;
        crew.accounts[number] = account;
        crew.growth.push(Told {
            at,
            worker: number,
            made: account.made(),
        });
    }
    Ok(crew)
}

/// A line of a worker, or its end, and when it was heard.
pub type Heard<A> = (usize, Option<Line<A>>, Instant);

fn next<A>(lines: &Receiver<Heard<A>>) -> Result<Heard<A>, PlanningError> {
    let line = lines.recv();
    line.map_err(|_| lost(0, "all workers have ended early; what they said is above"))
}

/// A worker; killed when it is dropped.
pub struct Process {
    number: usize,
    child: Child,
    input: Option<ChildStdin>,
}

impl Process {
    /// Starts one that passes on what it hears for as long as `told` takes it.
    pub fn start<J: Job>(
        job: &J,
        told: impl Fn(Heard<J::Account>) -> bool + Send + 'static,
    ) -> Result<Process, PlanningError> {
        let number = job.number();
        let failed = |problem: io::Error| lost(number, problem);
        let program = env::current_exe().map_err(failed)?;
        let mut child = Command::new(program)
            .arg(J::ROLE)
            .args(job.arguments())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let input = child.stdin.take();
        let output = child.stdout.take();
        thread::spawn(move || {
            let lines = output.map(BufReader::new).into_iter();
            for line in lines.flat_map(BufRead::lines).map_while(Result::ok) {
                let line = serde_json::from_str(&line).ok();
                if line.is_some() && !told((number, line, Instant::now())) {
                    return;
                }
            }
            // Nobody listens when all is over.
            let _ = told((number, None, Instant::now()));
        });
        Ok(Process {
            number,
            child,
            input,
        })
    }

    /// Lets it begin.
    pub fn begin(&mut self) -> Result<(), PlanningError> {
        let Some(input) = &mut self.input else {
            return Ok(());
        };
        let written = input.write_all(b"go\n");
        written.map_err(|problem| lost(self.number, problem))
    }

    fn kill(&mut self) -> Result<(), PlanningError> {
        let killed = self.child.kill();
        killed.map_err(|problem| lost(self.number, problem))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Either fails only if it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
