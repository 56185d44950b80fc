//! Verifying an index.

use std::time::Duration;

use tokio::time::timeout;
use wayfold_proto::v1::{self, verify_index_response::Result as Answer};

use super::awaitable;
use crate::{Error, IndexHandle, IndexInfo};

/// Compares what an index answers from with what is stored, at one revision: all points, and sampled queries with brute
/// force over the stored points. Await it for the whole, or watch it ([`Verify::watched`]).
///
/// ```no_run
/// # async fn example(index: wayfold::IndexHandle) -> Result<(), wayfold::Error> {
/// let verified = index.verify().queries(100).await?;
/// assert!(verified.agrees(), "{:?}", verified.first_disagreements);
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Verify {
    index: IndexHandle,
    queries: Option<u32>,
    k: Option<u32>,
    seed: u64,
}

/// What a verification found.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Verified {
    /// The index, at the revision that was verified.
    pub index: IndexInfo,
    /// How many points are stored; `index.points` are searched.
    pub stored_points: u64,
    /// SHA-256 of the space and the stored points, whatever their revisions: indices of equal content have equal
    /// hashes, on any server.
    pub content_hash: [u8; 32],
    /// How many states were asked about.
    pub queries: u64,
    /// How many disagreements there are.
    pub disagreements: u64,
    /// The first few of them, in words.
    pub first_disagreements: Vec<String>,
}

impl Verified {
    /// Whether what is searched is what is stored, and the answers were those of brute force.
    pub fn agrees(&self) -> bool {
        self.disagreements == 0
    }
}

awaitable!(Verify => Verified);

const CALL: &str = "verify_index";

impl Verify {
    pub(crate) fn new(index: IndexHandle) -> Verify {
        Verify {
            index,
            queries: None,
            k: None,
            seed: 0,
        }
    }

    /// Asks about so many states, at most 1000; 32 unless set.
    pub fn queries(mut self, queries: u32) -> Verify {
        self.queries = Some(queries);
        self
    }

    /// Asks for so many neighbours of each, from 1 to 100; 10 unless set.
    pub fn k(mut self, k: u32) -> Verify {
        self.k = Some(k);
        self
    }

    /// Draws the states from this seed; 0 unless set.
    pub fn seed(mut self, seed: u64) -> Verify {
        self.seed = seed;
        self
    }

    async fn send(self) -> Result<Verified, Error> {
        self.watched(|_, _| ()).await
    }

    /// Does it, and tells from time to time how many points were read, and how many will have been at the end. The
    /// handle's timeout bounds the wait for each such word, not the whole.
    ///
    /// # Errors
    /// Those of every call. `DATA_LOSS`: stored points cannot be read. A disagreement is no error.
    pub async fn watched(self, mut progress: impl FnMut(u64, u64)) -> Result<Verified, Error> {
        let (index, message) = (&self.index, self.message());
        let stub = index.client().indexes();
        let attempt = |_remaining: Duration| {
            let (mut stub, message) = (stub.clone(), message.clone());
            // Without a deadline, which would bound the whole stream.
            async move { stub.verify_index(message).await }
        };
        let waited = index.timeout();
        let mut answers = index.client().call(CALL, waited, attempt).await?;
        loop {
            let answer = timeout(waited, answers.message()).await;
            let answer = answer.map_err(|_| Error::timeout(CALL, waited))?;
            let answer = answer
                .map_err(|status| Error::from_status(CALL, index.client().uri(), waited, status))?;
            match answer.and_then(|answer| answer.result) {
                Some(Answer::Progress(at)) => progress(at.points_read, at.points_to_read),
                Some(Answer::Report(report)) => {
                    let verified = read(report)?;
                    index.told(&verified.index.uid, verified.index.revision);
                    return Ok(verified);
                }
                None => return Err(protocol("it ends without a report")),
            }
        }
    }

    fn message(&self) -> v1::VerifyIndexRequest {
        v1::VerifyIndexRequest {
            name: self.index.name().to_owned(),
            at: Some(self.index.read_at()),
            queries: self.queries,
            k: self.k,
            seed: self.seed,
        }
    }
}

fn read(report: v1::VerifyReport) -> Result<Verified, Error> {
    let hash = <[u8; 32]>::try_from(&report.content_hash[..]);
    Ok(Verified {
        index: IndexInfo::from_message(CALL, report.index)?,
        stored_points: report.stored_points,
        content_hash: hash.map_err(|_| protocol("a content hash that is none"))?,
        queries: report.queries,
        disagreements: report.disagreements,
        first_disagreements: report.first_disagreements,
    })
}

fn protocol(problem: &str) -> Error {
    Error::Protocol {
        call: CALL,
        problem: problem.to_owned(),
    }
}
