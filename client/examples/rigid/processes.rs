//! Workers as processes: this program again, told its role by its arguments, and telling its progress on its output, a
//! line of JSON each time.

use std::{
    env,
    io::{self, BufRead, BufReader, Write},
    process::{Child, ChildStdin, Command, Stdio},
    sync::mpsc::{self, Receiver},
    thread,
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};
use wayfold_client::Client;

use crate::{
    account::Account,
    nearby::Source,
    options::{Job, Kind},
    planning::error::PlanningError,
    scene::Rooms,
    worker::Worker,
};

/// What a worker tells.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Line {
    /// It waits for the line that lets all begin at once.
    Ready,
    /// What it has done so far.
    Progress(Account),
    /// What it has done at the end.
    Done(Account),
}

/// The role of a worker.
pub async fn work(job: &Job) -> Result<(), PlanningError> {
    let client = Client::connect(&job.server).await?;
    let index = client.index(&job.index).await?;
    let source = match job.source {
        Kind::Server => Source::Server,
        Kind::Replica => Source::Replica(client.replica(&job.index).await?),
    };
    let scene = Rooms::new();
    let worker = Worker::new(&scene, index, source, job.number, job.seed);
    let worker = worker.batch(job.batch);
    let mut worker = worker.min_separation(job.min_separation);

    tell(&Line::Ready)?;
    let mut go = String::new();
    let read = io::stdin().lock().read_line(&mut go);
    read.map_err(|problem| lost(job.number, problem))?;
    let progress = Duration::from_millis(job.progress_ms);
    let mut told = Instant::now();
    let extended = worker.extend(job.milestones, |account| {
        if told.elapsed() < progress {
            return Ok(());
        }
        told = Instant::now();
        tell(&Line::Progress(*account))
    });
    extended.await?;
    tell(&Line::Done(worker.account()))
}

/// Fails where nobody listens any more, and so ends a worker whose parent is gone.
fn tell(line: &Line) -> Result<(), PlanningError> {
    let mut output = io::stdout().lock();
    let written = serde_json::to_writer(&mut output, line).map_err(io::Error::from);
    let written = written.and_then(|()| output.write_all(b"\n"));
    let written = written.and_then(|()| output.flush());
    written.map_err(|problem| lost(0, problem))
}

/// What happened to a worker.
pub fn lost(number: usize, problem: impl ToString) -> PlanningError {
    PlanningError::Worker {
        number,
        problem: problem.to_string(),
    }
}

/// What the workers have done, and how it grew.
pub struct Crew {
    /// The account of each at its end; of one that was killed, the last it told.
    pub accounts: Vec<Account>,
    /// From the start of all to the end of the last.
    pub wall: Duration,
    /// When each told how many milestones it had.
    pub growth: Vec<Told>,
    /// Which was killed, and when.
    pub killed: Option<(usize, Duration)>,
}

/// A worker's progress.
#[derive(Clone, Copy, Debug)]
pub struct Told {
    /// Since the start of all.
    pub at: Duration,
    /// Which worker.
    pub worker: usize,
    /// How many milestones it had.
    pub milestones: u64,
}

/// Runs these jobs side by side, to their end; where `kill` says so, kills the first when it has half its share.
pub fn run(jobs: &[Job], kill: bool) -> Result<Crew, PlanningError> {
    let (told, lines) = mpsc::channel();
    let mut processes = Vec::with_capacity(jobs.len());
    for job in jobs {
        let told = told.clone();
        processes.push(Process::start(job, move |heard| told.send(heard).is_ok())?);
    }
    drop(told);
    for _ in jobs {
        match next(&lines)? {
            (_, Some(Line::Ready)) => {}
            (number, _) => return Err(lost(number, "it ended before it was ready")),
        }
    }
    let started = Instant::now();
    for process in &mut processes {
        process.begin()?;
    }
    let mut crew = Crew {
        accounts: vec![Account::default(); jobs.len()],
        wall: Duration::ZERO,
        growth: Vec::new(),
        killed: None,
    };
    let mut done = vec![false; jobs.len()];
    let mut working = jobs.len();
    while working > 0 {
        let (number, line) = next(&lines)?;
        let at = started.elapsed();
        let was_killed = crew.killed.is_some_and(|(killed, _)| killed == number);
        let account = match line {
            Some(Line::Progress(account)) => account,
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
            milestones: account.milestones,
        });
        let share = jobs[number].milestones / jobs.len() as u64;
        if kill && number == 0 && crew.killed.is_none() && 2 * account.milestones >= share {
            processes[number].kill()?;
            crew.killed = Some((number, at));
        }
    }
    Ok(crew)
}

/// A line of a worker, or its end.
pub type Heard = (usize, Option<Line>);

fn next(lines: &Receiver<Heard>) -> Result<Heard, PlanningError> {
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
    pub fn start(
        job: &Job,
        told: impl Fn(Heard) -> bool + Send + 'static,
    ) -> Result<Process, PlanningError> {
        let number = job.number;
        let failed = |problem: io::Error| lost(number, problem);
        let program = env::current_exe().map_err(failed)?;
        let mut child = Command::new(program)
            .arg("work")
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
                if line.is_some() && !told((number, line)) {
                    return;
                }
            }
            // Nobody listens when all is over.
            let _ = told((number, None));
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
