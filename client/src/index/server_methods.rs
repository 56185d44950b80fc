//! The methods that matter only for an index of a server.

use std::{sync::Arc, time::Duration};

use super::{
    ConnectionStatus, Index, MeanwhileAnswers, OpenRemote, OpenShared, UnsentWrite,
    shared::SharedIndex,
};
use crate::{Error, PayloadEncoding};

impl Index {
    /// The index of this name on a server, with a copy of it in this process: own writes are in the copy at once and
    /// travel in the background, writes of others arrive as they happen.
    ///
    /// A read sees everything up to one revision of the server's, and own writes after it in the order of their calls.
    ///
    /// `uri` may name several servers that share their indices, with commas between them: the index goes on at another
    /// one when its server is unavailable ([`ClientBuilder::connect`](crate::ClientBuilder::connect)).
    pub fn shared(uri: &str, name: &str) -> OpenShared {
        OpenShared::new(uri, name)
    }

    /// Acts like [`Index::shared`], but all calls go over Zenoh: it needs no gRPC port. The session must reach the
    /// server, directly or through routers, and must stay open; `wayfold/v1` is the default prefix of a server.
    /// [`OpenShared::open`] waits up to its timeout for a server to appear.
    ///
    /// ```no_run
    /// use wayfold::Index;
    ///
    /// # fn example(session: zenoh::Session) -> Result<(), Box<dyn std::error::Error>> {
    /// let index = Index::shared_over_zenoh(session, "wayfold/v1", "arm").create(&"R3*SO3:0.15".parse()?).open()?;
    /// # Ok(())
    /// # }
    /// ```
    #[cfg(feature = "zenoh")]
    pub fn shared_over_zenoh(session: zenoh::Session, prefix: &str, name: &str) -> OpenShared {
        OpenShared::over_zenoh(session, prefix, name)
    }

    /// The index of this name on a server, without a copy: each call is one of the server's, and waits for it. `uri`
    /// may name several servers, as for [`Index::shared`].
    pub fn remote(uri: &str, name: &str) -> OpenRemote {
        OpenRemote::new(uri, name)
    }

    pub(super) fn of_shared(shared: SharedIndex) -> Index {
        Index {
            shared: Some(Arc::clone(&shared.core)),
            ..Index::of(Arc::new(shared))
        }
    }

    /// How the payloads hold edges, as the index declared when it was created: another program may have created it, and a
    /// payload that means something else may look like edges. `Unspecified` if it declares nothing, in memory, and for a
    /// shared index in a forked process.
    pub fn payload_encoding(&self) -> PayloadEncoding {
        match &self.shared {
            Some(shared) => shared.payload_encoding(),
            None => self.payload_encoding,
        }
    }

    /// Waits until the server has acknowledged every write before this call: they are as durable then as the server is
    /// configured. Returns at once for the other forms.
    ///
    /// # Errors
    /// [`Error::Timeout`]; the writes stay pending. [`Error::WritesRefused`]: see [`Index::take_unsent`].
    /// [`Error::Ended`], [`Error::Forked`], [`Error::Interrupted`].
    pub fn flush(&self) -> Result<(), Error> {
        let shared = self.shared.as_ref();
        shared.map_or(Ok(()), |shared| shared.flush(shared.settings.timeout))
    }

    /// Acts like [`Index::flush`], but waits at most for `timeout` instead of the index's own.
    ///
    /// # Errors
    /// Those of [`Index::flush`].
    pub fn flush_within(&self, timeout: Duration) -> Result<(), Error> {
        self.shared
            .as_ref()
            .map_or(Ok(()), |shared| shared.flush(timeout))
    }

    /// The number of writes that the server has not acknowledged; 0 for the other forms.
    pub fn pending(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| shared.pending())
    }

    /// The state of a shared index's connection; `None` for the other forms.
    pub fn status(&self) -> Option<ConnectionStatus> {
        self.shared.as_ref().map(|shared| shared.status())
    }

    /// The answers about own points that were inserted with a search: the neighbours that others stored before them
    /// in the index's order and that the insert could not see, and with a scaled `k` the older ones that the insert left
    /// out. Each point is answered once, when the feed has named it, also without such neighbours. In the other forms an
    /// insert sees all.
    pub fn meanwhile(&self) -> MeanwhileAnswers {
        self.shared
            .as_ref()
            .map_or_else(MeanwhileAnswers::default, |shared| shared.meanwhile())
    }

    /// Acts like [`Index::meanwhile`], but waits for an answer, at most for `timeout`, if there is none and one is to
    /// come.
    pub fn wait_meanwhile(&self, timeout: Duration) -> MeanwhileAnswers {
        let shared = self.shared.as_ref();
        shared.map_or_else(MeanwhileAnswers::default, |shared| {
            shared.wait_meanwhile(timeout)
        })
    }

    /// Every write from the first one on that the server refused for good, in order; the copy shows them no more. After
    /// this call the index takes writes again, in a new session, unless it was closed or is gone ([`Error::Ended`]).
    ///
    /// The server may have taken the first batch of them: after the reconnection look whether its points are there. Store
    /// a put again without its id if the index assigned it: the id stays reserved for the session that ended.
    pub fn take_unsent(&self) -> Vec<UnsentWrite> {
        self.shared
            .as_ref()
            .map_or_else(Vec::new, |shared| shared.take_unsent())
    }

    /// Takes no more writes, waits for the pending ones, and returns those that the server has not acknowledged within
    /// `timeout`: it may have taken the first of them. An index in another form has none, and stays open.
    pub fn close(&self, timeout: Duration) -> Vec<UnsentWrite> {
        self.shared
            .as_ref()
            .map_or_else(Vec::new, |shared| shared.close(timeout))
    }
}
