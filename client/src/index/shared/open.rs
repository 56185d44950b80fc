//! Opening a shared index.

use std::{panic::AssertUnwindSafe, sync::Arc, time::Duration};

use futures_util::FutureExt;
use wayfold_index::Space;

use super::{
    SharedIndex,
    core::{Core, Settings},
    link::{Address, Link},
    pending::PendingWrites,
    sender,
    subscriber::Subscriber,
};
use crate::{
    Credentials, Error, Index, PayloadEncoding,
    index::{
        local::LocalPoints,
        runtime::{spawn, wait_for},
    },
    net::request::{MAX_WAIT, fresh_operation_id},
};

/// Settings of a shared index: [`OpenShared::open`] reads all points and returns it.
///
/// ```no_run
/// use wayfold::Index;
///
/// let index = Index::shared("http://127.0.0.1:50051", "arm").create(&"R3*SO3:0.15".parse()?).open()?;
/// let id = index.insert([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])?;
/// // Until the server has it, as durably as it is configured.
/// index.flush()?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
#[must_use = "call open"]
pub struct OpenShared {
    address: Address,
    name: String,
    space: Option<Space>,
    payload_encoding: PayloadEncoding,
    timeout: Duration,
    max_pending_bytes: usize,
    credentials: Credentials,
}

impl OpenShared {
    pub(in crate::index) fn new(uri: &str, name: &str) -> OpenShared {
        let uri = uri.to_owned();
        OpenShared::at(Address::Grpc { uri }, name)
    }

    #[cfg(feature = "zenoh")]
    pub(in crate::index) fn over_zenoh(
        session: zenoh::Session,
        prefix: &str,
        name: &str,
    ) -> OpenShared {
        let prefix = prefix.to_owned();
        OpenShared::at(Address::Zenoh { session, prefix }, name)
    }

    fn at(address: Address, name: &str) -> OpenShared {
        OpenShared {
            address,
            name: name.to_owned(),
            space: None,
            payload_encoding: PayloadEncoding::Unspecified,
            timeout: Duration::from_secs(30),
            max_pending_bytes: 16 << 20,
            credentials: Credentials::default(),
        }
    }

    /// Creates the index with this space if it is missing. An index with another space is refused.
    pub fn create(mut self, space: &Space) -> OpenShared {
        self.space = Some(space.clone());
        self
    }

    /// How the payloads of an index that is created here hold edges: nothing is declared unless set. An index that
    /// declares another encoding is refused; one that declares nothing is opened ([`Index::payload_encoding`] tells).
    pub fn payload_encoding(mut self, encoding: PayloadEncoding) -> OpenShared {
        self.payload_encoding = encoding;
        self
    }

    /// The longest time that a call waits: for the connection, for room among the pending writes, for a flush. 30 s
    /// unless set. `insert_many` waits so for each part of its rows.
    pub fn timeout(mut self, timeout: Duration) -> OpenShared {
        self.timeout = timeout.min(MAX_WAIT);
        self
    }

    /// The most bytes of writes, and of the searches of inserts, that are not yet acknowledged and back from the feed: 16
    /// MiB unless set; the answer of one search may exceed them. A write that exceeds them waits, as does one without an
    /// id of its own once the ids that the server has reserved are spent.
    pub fn max_pending_bytes(mut self, bytes: usize) -> OpenShared {
        self.max_pending_bytes = bytes;
        self
    }

    /// The certificates and the token of the connection: none unless set. Over Zenoh only the token counts; the session
    /// has its own certificates.
    pub fn credentials(mut self, credentials: Credentials) -> OpenShared {
        self.credentials = credentials;
        self
    }

    /// Connects to the first server that answers, opens a writer session, reads all points and begins to follow the
    /// index.
    ///
    /// # Errors
    /// [`Error::Address`], [`Error::Connection`], [`Error::Timeout`]. `NOT_FOUND`: there is no index of this name.
    /// `ALREADY_EXISTS`: it has another space or encoding. [`Error::Argument`]: a prefix or a name that is no key of Zenoh.
    /// Those of [`ClientBuilder::connect`](crate::ClientBuilder::connect), [`Error::Forked`], [`Error::Thread`],
    /// [`Error::Interrupted`], and every refusal of the server. `PERMISSION_DENIED`: the caller lacks the role write.
    /// `RESOURCE_EXHAUSTED`: the index has all its sessions.
    pub fn open(self) -> Result<Index, Error> {
        let core = wait_for(self.connect())?;
        let (index, revision) = core.published.lock().clone();
        let subscriber = Subscriber::new(Arc::clone(&core), index, revision);
        let sending = sender::run(Arc::clone(&core));
        let tasks = [
            spawn(supervised(Arc::clone(&core), sending))?.abort_handle(),
            spawn(supervised(Arc::clone(&core), subscriber.run()))?.abort_handle(),
        ];
        Ok(Index::of_shared(SharedIndex { core, tasks }))
    }

    async fn connect(self) -> Result<Arc<Core>, Error> {
        let (link, limits) =
            Link::open(self.address, &self.name, self.timeout, &self.credentials).await?;
        let index = Arc::new(match &self.space {
            Some(space) => link.create(space, self.payload_encoding).await?,
            None => link.index().await?,
        });
        let mut writes = PendingWrites::new(index.coordinate_count);
        writes.limits = limits;
        let operation_id = fresh_operation_id();
        let opened = link.open_session(&index, writes.id_block(), &operation_id);
        let opened = opened.await?;
        writes.open(opened.session, opened.reserved);
        let mut points = LocalPoints::new(&index.space);
        let (forest, revision, _) = link.load(&index, 0, points.read_revision().0 + 1).await?;
        drop(points.replace(forest));
        Ok(Core::new(
            link,
            index,
            revision,
            points,
            writes,
            Settings {
                timeout: self.timeout,
                max_pending_bytes: self.max_pending_bytes,
            },
        ))
    }
}

/// Runs a task of an index. The index ends if it panics: its copy would never change again, or its writes would wait
/// without end.
async fn supervised(core: Arc<Core>, task: impl Future<Output = ()>) {
    if AssertUnwindSafe(task).catch_unwind().await.is_err() {
        let why = Error::protocol("shared index", "one of its tasks panicked, which is a bug");
        core.end(why);
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::net::TcpListener;

    use wayfold_proto::v1;

    use super::*;
    use crate::{Client, ConnectionStatus, IndexInfo, Limits, Revision, UnsentWrite};

    /// The state of an empty index that has one id to give, and no task.
    pub(in crate::index::shared) fn core(timeout: Duration, max_pending_bytes: usize) -> Arc<Core> {
        // A client connects to it without an answer.
        let silent = TcpListener::bind("127.0.0.1:0").unwrap();
        let uri = format!("http://{}", silent.local_addr().unwrap());
        let client = wait_for(async move { Client::connect(&uri).await }).unwrap();
        let space: Space = "R1".parse().unwrap();
        let index = IndexInfo {
            name: "arm".to_owned(),
            revision: Revision::new("uid", 0),
            point_count: 0,
            coordinate_count: space.coordinates(),
            dimension: space.dimension(),
            memory_bytes: 0,
            payload_encoding: PayloadEncoding::Unspecified,
            space: space.clone(),
        };
        let mut writes = PendingWrites::new(space.coordinates());
        writes.limits = Limits {
            max_payload_bytes: 1,
            max_reserved_ids: 1,
            ..Limits::NONE
        };
        let reserved = v1::IdBlock {
            first_id: 7,
            id_count: 1,
        };
        writes.open(1, Some(reserved));
        Core::new(
            Link::of_client(client),
            Arc::new(index),
            0,
            LocalPoints::new(&space),
            writes,
            Settings {
                timeout,
                max_pending_bytes,
            },
        )
    }

    #[test]
    fn a_panic_of_a_task_ends_the_index_and_the_waits_of_its_writers() {
        let core = core(Duration::from_secs(30), 1 << 20);
        let called = Arc::clone(&core);
        let task = spawn(supervised(Arc::clone(&core), async move {
            // A writer that is about to wait calls the sender.
            called.urgent.notified().await;
            panic!("a bug of the test");
        }));
        let task = task.unwrap().abort_handle();
        let index = Index::of_shared(SharedIndex {
            core,
            tasks: [task.clone(), task],
        });
        assert_eq!(index.insert([0.0]).unwrap(), 7);
        // No id is left, so this one waits.
        let waited = index.insert([1.0]);
        let Err(Error::Ended { why }) = &waited else {
            panic!("{waited:?}");
        };
        let why = why.to_string();
        assert!(why.contains("one of its tasks panicked"), "{why}");
        let status = index.status();
        assert!(
            matches!(status, Some(ConnectionStatus::Ended { .. })),
            "{status:?}"
        );
        for refused in [index.flush(), index.nearest([0.0]).map(drop)] {
            assert!(refused.is_err(), "{refused:?}");
        }
        let unsent = index.take_unsent();
        assert!(
            matches!(&unsent[..], [UnsentWrite::Put { id: 7, .. }]),
            "{unsent:?}"
        );
    }
}
