//! The errors of the planners.

use std::{io, path::PathBuf, process::ExitCode};

use thiserror::Error;

/// The exit status of a program that ended so. Prints its error.
pub fn exit_code(ended: Result<(), PlanningError>) -> ExitCode {
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// The error of a run without a result.
#[derive(Debug, Error)]
pub enum PlanningError {
    /// A source that is reached over the network did not answer.
    #[error(transparent)]
    Client(#[from] wayfold::Error),
    /// The threads of the client could not be started.
    #[error("cannot start the threads that talk to a server: {0}")]
    Threads(io::Error),
    /// A server could not be started.
    #[error("cannot start a server ({0}); --server URI takes one that runs already")]
    Server(io::Error),
    /// The trees reached their maximum size without meeting.
    #[error(
        "no path with {nodes} nodes; try another --seed, or more of them (--max-nodes, --rrt-star)"
    )]
    Unsolved {
        /// The number of nodes.
        nodes: usize,
    },
    /// The finer check found a collision.
    #[error(
        "the path collides between its states {segment} and {next}: the planner's check is too coarse",
        next = segment + 1
    )]
    Collision {
        /// The first state of the segment.
        segment: usize,
    },
    /// Two exact sources found different neighbours.
    #[error("{first} and {other} grew different graphs from seed {seed}: one of them is not exact")]
    Differing {
        /// The first source.
        first: String,
        /// The source that differs from it.
        other: String,
        /// The seed of both runs.
        seed: u64,
    },
    /// A worker's process failed.
    #[error("worker {number}: {problem}")]
    Worker {
        /// The number.
        number: usize,
        /// The cause.
        problem: String,
    },
    /// A point of the roadmap has unreadable or dangling edges.
    #[error("milestone {id} has a payload that tells no edges; is the index another program's?")]
    Payload {
        /// Its id.
        id: u64,
    },
    /// A vertex of a shared tree is wrong.
    #[error("vertex {id}: {problem}; is the index another program's?")]
    Vertex {
        /// Its id.
        id: u64,
        /// The difference.
        problem: &'static str,
    },
    /// A source on a server was opened without one.
    #[error("an index on a server needs the address of one")]
    NoServer,
    /// Several processes were to share a source that is local to one process.
    #[error("{source_name} is within one process; workers take --source shared or remote")]
    Unshared {
        /// The source name.
        source_name: &'static str,
    },
    /// The watch of a roadmap ended.
    #[error(
        "the server has forgotten how the roadmap grew before that was asked for; is it too busy?"
    )]
    Unfollowed,
    /// A milestone differs from its counterpart in a serial replay of the same states.
    #[error("milestone {id}: {problem}")]
    Replay {
        /// Its id.
        id: u64,
        /// The difference.
        problem: String,
    },
    /// The roadmap does not connect two states.
    #[error("no way {task} with {milestones} milestones; try more with --milestones")]
    Unconnected {
        /// The two states.
        task: String,
        /// The number of milestones.
        milestones: usize,
    },
    /// A picture could not be drawn, or a file could not be written.
    #[error("{}: {problem}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The error of the system or the drawing library.
        problem: String,
    },
}
