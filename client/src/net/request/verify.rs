//! Verifying an index.

use wayfold_proto::v1::{self, verify_index_response::Result as Answer};

use super::{awaitable, receive};
use crate::{Error, IndexHandle, IndexInfo, net::connections::Connection};

/// Compares the searched points with the stored ones, at one revision, and the answers to sampled queries with brute
/// force over the stored points. Await it for the report, or follow its progress ([`Verify::with_progress`]).
///
/// ```no_run
/// # async fn example(index: wayfold::IndexHandle) -> Result<(), wayfold::Error> {
/// let verified = index.verify().query_count(100).await?;
/// assert!(verified.agrees(), "{:?}", verified.first_disagreements);
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
#[must_use = "a request does nothing until it is awaited"]
pub struct Verify {
    index: IndexHandle,
    query_count: Option<u32>,
    k: Option<u32>,
    seed: u64,
}

/// The result of a verification.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Verified {
    /// The index, at the revision that was verified.
    pub index: IndexInfo,
    /// The number of stored points; `index.point_count` is the number of searched ones.
    pub stored_point_count: u64,
    /// SHA-256 of the space and the stored points, without their revisions: indices of equal content have equal hashes,
    /// on any server.
    pub content_hash: [u8; 32],
    /// The number of sampled states.
    pub query_count: u64,
    /// The number of disagreements.
    pub disagreement_count: u64,
    /// The first few of them, in words.
    pub first_disagreements: Vec<String>,
}

impl Verified {
    /// True if the searched points are the stored ones, and the answers are those of brute force.
    pub fn agrees(&self) -> bool {
        self.disagreement_count == 0
    }
}

awaitable!(Verify => Verified);

const CALL: &str = "verify_index";

impl Verify {
    pub(crate) fn new(index: IndexHandle) -> Verify {
        Verify {
            index,
            query_count: None,
            k: None,
            seed: 0,
        }
    }

    /// Searches around this many states, at most 1000; 32 unless set.
    pub fn query_count(mut self, count: u32) -> Verify {
        self.query_count = Some(count);
        self
    }

    /// Finds this many neighbours of each, from 1 to 100; 10 unless set.
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
        self.with_progress(|_, _| ()).await
    }

    /// Sends the request, and calls `progress` from time to time with the number of points that the server has read and
    /// the number that it will have read at the end. The handle's timeout bounds the wait for each message, not the
    /// whole.
    ///
    /// # Errors
    /// Those of every call. `DATA_LOSS`: stored points cannot be read. A disagreement is no error.
    pub async fn with_progress(
        self,
        mut progress: impl FnMut(u64, u64),
    ) -> Result<Verified, Error> {
        let index = &self.index;
        let open = |connection: Connection| {
            let message = self.message();
            async move { connection.indexes().verify_index(message).await }
        };
        let mut answers = index.open_stream(CALL, None, open).await?;
        loop {
            let answer = receive(CALL, index, &mut answers).await?;
            match answer.and_then(|answer| answer.result) {
                Some(Answer::Progress(at)) => progress(at.read_point_count, at.total_point_count),
                Some(Answer::Report(report)) => {
                    let verified = verified(report)?;
                    index.note(&verified.index.revision);
                    return Ok(verified);
                }
                None => return Err(Error::protocol(CALL, "it ends without a report")),
            }
        }
    }

    fn message(&self) -> v1::VerifyIndexRequest {
        v1::VerifyIndexRequest {
            index_name: self.index.name().to_owned(),
            min_revision: self.index.min_revision(),
            query_count: self.query_count,
            k: self.k,
            seed: self.seed,
        }
    }
}

fn verified(report: v1::VerifyReport) -> Result<Verified, Error> {
    let hash = <[u8; 32]>::try_from(&report.content_hash[..]);
    Ok(Verified {
        index: IndexInfo::from_message(CALL, report.index)?,
        stored_point_count: report.stored_point_count,
        content_hash: hash
            .map_err(|_| Error::protocol(CALL, "the content hash does not have 32 bytes"))?,
        query_count: report.query_count,
        disagreement_count: report.disagreement_count,
        first_disagreements: report.first_disagreements,
    })
}
