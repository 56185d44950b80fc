//! Opening a shared index.

use std::{sync::Arc, time::Duration};

use wayfold_index::Space;

use super::{
    SharedIndex,
    core::{Core, ID_BLOCK},
    follower::Follower,
    link::Link,
    sender,
    writer::Writer,
};
use crate::{
    Error, Index,
    index::{
        local::LocalPoints,
        runtime::{runtime, wait_for},
    },
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
    uri: String,
    name: String,
    space: Option<Space>,
    timeout: Duration,
    max_pending_bytes: usize,
    #[cfg(feature = "zenoh")]
    publications: Option<super::publications::Publications>,
}

impl OpenShared {
    pub(in crate::index) fn new(uri: &str, name: &str) -> OpenShared {
        OpenShared {
            uri: uri.to_owned(),
            name: name.to_owned(),
            space: None,
            timeout: Duration::from_secs(30),
            max_pending_bytes: 16 << 20,
            #[cfg(feature = "zenoh")]
            publications: None,
        }
    }

    /// Creates the index with this space if it is missing. An index with another space is refused.
    pub fn create(mut self, space: &Space) -> OpenShared {
        self.space = Some(space.clone());
        self
    }

    /// The longest time that a call waits: for the connection, for room among the pending writes, for a flush. 30 s
    /// unless set.
    pub fn timeout(mut self, timeout: Duration) -> OpenShared {
        self.timeout = timeout;
        self
    }

    /// The most bytes of pending writes: 16 MiB unless set. A write that exceeds them waits.
    pub fn max_pending_bytes(mut self, bytes: usize) -> OpenShared {
        self.max_pending_bytes = bytes;
        self
    }

    /// Gets mutations over Zenoh instead: from the index's publications at `PREFIX/NAME/events`, and from its log if
    /// publications were lost. The session must reach the server, directly or through routers, and lives in a runtime
    /// of the caller's; `wayfold/v1` is the default prefix of a server. Writes and the first read of all points go over
    /// gRPC.
    #[cfg(feature = "zenoh")]
    pub fn over_zenoh(mut self, session: zenoh::Session, prefix: &str) -> OpenShared {
        let publications = super::publications::Publications::new(session, prefix);
        self.publications = Some(publications);
        self
    }

    /// Connects, opens a writer session, reads all points and begins to follow the index.
    ///
    /// # Errors
    /// [`Error::Address`], [`Error::Connection`], [`Error::Timeout`]. `NOT_FOUND`: there is no index of this name.
    /// `ALREADY_EXISTS`: it has another space.
    pub fn open(self) -> Result<Index, Error> {
        let core = wait_for(self.connect())?;
        let runtime = runtime()?;
        let (index, revision) = core.published.lock().clone();
        let follower = Follower::new(Arc::clone(&core), index, revision);
        let tasks = [
            runtime.spawn(sender::run(Arc::clone(&core))).abort_handle(),
            runtime.spawn(follower.run()).abort_handle(),
        ];
        Ok(Index::of_shared(SharedIndex::new(core, tasks)))
    }

    async fn connect(self) -> Result<Arc<Core>, Error> {
        #[cfg_attr(
            not(feature = "zenoh"),
            expect(unused_mut, reason = "publications change it")
        )]
        let (mut link, index) =
            Link::open(&self.uri, &self.name, self.timeout, self.space.as_ref()).await?;
        #[cfg(feature = "zenoh")]
        if let Some(publications) = self.publications {
            link.follow_over(publications);
        }
        let mut writer = Writer::new(index.coordinates());
        let (max_rows, max_request_bytes) = link.limits(self.timeout).await?;
        writer.limit(max_rows, max_request_bytes);
        let opened = link.open_session(&index, ID_BLOCK).await?;
        writer.open(opened.session, opened.reserved);
        let mut points = LocalPoints::new(index.space());
        let (forest, revision) = link.load(&index, points.seen().0 + 1).await?;
        points.replace(forest);
        Ok(Core::new(
            link,
            index,
            revision,
            points,
            writer,
            self.timeout,
            self.max_pending_bytes,
        ))
    }
}
