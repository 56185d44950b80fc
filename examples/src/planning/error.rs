//! What can go wrong with a planner.

use std::{io, path::PathBuf};

use thiserror::Error;

/// Why there is no result.
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
    /// The trees grew as large as they may without meeting.
    #[error(
        "no path with {nodes} nodes; try another --seed, or more of them (--max-nodes, --rrt-star)"
    )]
    Unsolved {
        /// How many nodes there are.
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
        /// The source that was asked first.
        first: String,
        /// The source that differs from it.
        other: String,
        /// The seed of both runs.
        seed: u64,
    },
    /// A worker's process failed.
    #[error("worker {number}: {problem}")]
    Worker {
        /// Which.
        number: usize,
        /// What happened to it.
        problem: String,
    },
    /// A point of the roadmap has edges that cannot be read, or that lead nowhere.
    #[error("milestone {id} has a payload that tells no edges; is the index another program's?")]
    Payload {
        /// Which.
        id: u64,
    },
    /// A vertex of a shared tree is not what it must be.
    #[error("vertex {id}: {problem}; is the index another program's?")]
    Vertex {
        /// Which.
        id: u64,
        /// How it differs.
        problem: &'static str,
    },
    /// A source that each process has for itself was asked of several.
    #[error("{source_name} is within one process; workers take --source server or replica")]
    Unshared {
        /// Which.
        source_name: &'static str,
    },
    /// Who follows a roadmap is not told of it any more.
    #[error(
        "the server has forgotten how the roadmap grew before that was asked for; is it too busy?"
    )]
    Unfollowed,
    /// A milestone is not what it is in a serial replay of the same states.
    #[error("milestone {id}: {problem}")]
    Replay {
        /// Which.
        id: u64,
        /// How it differs.
        problem: String,
    },
    /// The roadmap does not connect two states.
    #[error("no way {task} with {milestones} milestones; try more with --milestones")]
    Unconnected {
        /// From where to where.
        task: String,
        /// How many milestones there are.
        milestones: usize,
    },
    /// A picture could not be drawn or a file not be written.
    #[error("{}: {problem}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// What the system or the drawing library said.
        problem: String,
    },
}
