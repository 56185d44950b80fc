//! A client that reads and keeps the exact answers, each with its revision and index.

use rand::RngExt;
use tokio::{net::unix::pipe, sync::watch};
use tonic::{Code, Status};
use wayfold_proto::v1::{
    Filter, GetRequest, GetResponse, KnnRequest, KnnResponse, Revision, knn_request::KForm,
};
use wayfold_tests::{Content, INCLUDE_ALL, Model, States, Stubs, number, revision, row_states};

use super::{COORDINATES, SPACE};

/// One read in this many is a scan of everything.
const SCANS: u32 = 30;
/// The maximum number of revisions before the newest read one from which a reader asks for changes.
const MAX_REVISIONS_BACK: u64 = 2;

/// An answer to a reader.
pub(crate) enum ReaderAnswer {
    Knn(KnnRequest, KnnResponse),
    Get(GetRequest, GetResponse),
    Scan(Content),
}

impl ReaderAnswer {
    /// The index and the revision of the answer.
    pub(crate) fn at(&self) -> (&str, u64) {
        match self {
            ReaderAnswer::Knn(_, response) => at(&response.revision),
            ReaderAnswer::Get(_, response) => at(&response.revision),
            ReaderAnswer::Scan(content) => (&content.uid, content.revision),
        }
    }

    /// Checks the answer against the model, which has the answer's revision.
    pub(crate) fn check(&self, model: &Model) {
        match self {
            ReaderAnswer::Knn(request, response) => model.knn(request, response),
            ReaderAnswer::Get(request, response) => model.get(request, response),
            ReaderAnswer::Scan(content) => model.check_content(content),
        }
    }
}

/// A client that reads.
pub(crate) struct Reader {
    states: States,
    ids: Vec<u64>,
    newest: u64,
    uid: String,
    /// The answers since they were last taken.
    pub(crate) seen: Vec<ReaderAnswer>,
    /// The refusals since then.
    pub(crate) refusals: Vec<Status>,
    /// The number of refused searches, which need no read of the disk.
    pub(crate) searches_refused: usize,
}

impl Reader {
    pub(crate) fn new(seed: u64, uid: &str) -> Self {
        Self {
            states: States::new(SPACE.parse().unwrap(), seed),
            ids: Vec::new(),
            newest: 0,
            uid: uid.to_owned(),
            seen: Vec::new(),
            refusals: Vec::new(),
            searches_refused: 0,
        }
    }

    /// Reads until the signal to stop, whatever the answers are, and signals each read. Unfinished mutations of others
    /// must not be visible.
    pub(crate) async fn read(
        mut self,
        stubs: Stubs,
        over: watch::Receiver<bool>,
        looked: Option<pipe::Sender>,
    ) -> Self {
        while !*over.borrow() {
            self.note(stubs.clone()).await;
            if let Some(looked) = &looked {
                // The pipe is full if the server has not read the last signals, and broken if the server was killed.
                let _ = looked.try_write(&[1]);
            }
        }
        self
    }

    /// Reads once and keeps the answer or the refusal.
    pub(crate) async fn note(&mut self, stubs: Stubs) {
        match self.look(stubs).await {
            Ok(seen) => self.seen.push(seen),
            // The point was removed meanwhile.
            Err(status) if status.code() == Code::NotFound => {}
            Err(status) => {
                assert_ne!(status.code(), Code::InvalidArgument, "{status}");
                self.refusals.push(status);
            }
        }
    }

    /// One read.
    pub(crate) async fn look(&mut self, mut stubs: Stubs) -> Result<ReaderAnswer, Status> {
        if self.states.rng().random_ratio(1, SCANS) {
            return Content::read(&stubs, "arm").await.map(ReaderAnswer::Scan);
        }
        if let Some(id) = self.ids.pop() {
            let request = GetRequest {
                index_name: "arm".into(),
                ids: vec![id],
                include: Some(INCLUDE_ALL),
                ..Default::default()
            };
            let response = stubs.points.get(request.clone()).await?;
            return Ok(ReaderAnswer::Get(request, response.into_inner()));
        }
        let request = KnnRequest {
            index_name: "arm".into(),
            states: Some(row_states(&self.states.rows(1), COORDINATES)),
            k_form: Some(KForm::K(20)),
            // Reads all of the newest points, because these are the ones that a failure may lose.
            filter: Some(Filter {
                since_revision: revision(&self.uid, self.newest.saturating_sub(MAX_REVISIONS_BACK)),
                ..Default::default()
            }),
            ..Default::default()
        };
        let answered = stubs.points.knn(request.clone()).await;
        self.searches_refused += usize::from(answered.is_err());
        let response = answered?.into_inner();
        self.newest = number(&response.revision);
        let neighbors = response.neighbors.as_ref();
        let ids = neighbors.into_iter().flat_map(|found| &found.ids);
        self.ids = ids.copied().take(1).collect();
        Ok(ReaderAnswer::Knn(request, response))
    }
}

fn at(revision: &Option<Revision>) -> (&str, u64) {
    let Revision { uid, number } = revision.as_ref().expect("a revision");
    (uid, *number)
}
