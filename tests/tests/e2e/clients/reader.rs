//! Reads, and notes the answers bit for bit, each with its revision and index.

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
/// A reader asks for the changes since a revision at most this far before the last that it saw.
const RECENT: u64 = 2;

/// An answer that a reader saw.
pub(crate) enum Seen {
    Knn(KnnRequest, KnnResponse),
    Get(GetRequest, GetResponse),
    Scan(Content),
}

impl Seen {
    /// The index and the revision that it is of.
    pub(crate) fn at(&self) -> (&str, u64) {
        match self {
            Seen::Knn(_, response) => at(&response.revision),
            Seen::Get(_, response) => at(&response.revision),
            Seen::Scan(content) => (&content.uid, content.revision),
        }
    }

    /// Checks that it is what there is to see at the model's revision.
    pub(crate) fn check(&self, model: &Model) {
        match self {
            Seen::Knn(request, response) => model.knn(request, response),
            Seen::Get(request, response) => model.get(request, response),
            Seen::Scan(content) => model.check_content(content),
        }
    }
}

/// A client that reads.
pub(crate) struct Reader {
    states: States,
    ids: Vec<u64>,
    newest: u64,
    uid: String,
    /// The answers since they were taken away last.
    pub(crate) seen: Vec<Seen>,
    /// The refusals since then.
    pub(crate) refusals: Vec<Status>,
    /// How many of these were searches, for which nothing needs to be read.
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

    /// Reads until it is over, whatever the answers are. Unfinished work of others must not be seen. It signals each
    /// read.
    pub(crate) async fn read(
        mut self,
        stubs: Stubs,
        over: watch::Receiver<bool>,
        looked: Option<pipe::Sender>,
    ) -> Self {
        while !*over.borrow() {
            self.note(stubs.clone()).await;
            if let Some(looked) = &looked {
                // The pipe is full if the other side has signals enough, and broken if the server was killed.
                let _ = looked.try_write(&[1]);
            }
        }
        self
    }

    /// Reads once, and notes the answer or the refusal.
    pub(crate) async fn note(&mut self, stubs: Stubs) {
        match self.look(stubs).await {
            Ok(seen) => self.seen.push(seen),
            // It was removed meanwhile.
            Err(status) if status.code() == Code::NotFound => {}
            Err(status) => {
                assert_ne!(status.code(), Code::InvalidArgument, "{status}");
                self.refusals.push(status);
            }
        }
    }

    /// One read.
    pub(crate) async fn look(&mut self, mut stubs: Stubs) -> Result<Seen, Status> {
        if self.states.rng().random_ratio(1, SCANS) {
            return Content::read(&stubs, "arm").await.map(Seen::Scan);
        }
        if let Some(id) = self.ids.pop() {
            let request = GetRequest {
                index_name: "arm".into(),
                ids: vec![id],
                include: Some(INCLUDE_ALL),
                ..Default::default()
            };
            let response = stubs.points.get(request.clone()).await?;
            return Ok(Seen::Get(request, response.into_inner()));
        }
        let request = KnnRequest {
            index_name: "arm".into(),
            states: Some(row_states(&self.states.rows(1), COORDINATES)),
            k_form: Some(KForm::K(20)),
            // All of the newest points, as it is these that might not be there any more.
            filter: Some(Filter {
                since_revision: revision(&self.uid, self.newest.saturating_sub(RECENT)),
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
        Ok(Seen::Knn(request, response))
    }
}

fn at(revision: &Option<Revision>) -> (&str, u64) {
    let Revision { uid, number } = revision.as_ref().expect("a revision");
    (uid, *number)
}
