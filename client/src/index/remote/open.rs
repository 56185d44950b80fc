//! Opening a remote index.

use std::{sync::Arc, time::Duration};

use wayfold_index::Space;

use super::Remote;
use crate::{
    Client, Credentials, Error, Index, PayloadEncoding, index::runtime::wait_for,
    net::request::MAX_WAIT,
};

/// Settings of a remote index: [`OpenRemote::open`] connects and returns it.
#[derive(Clone, Debug)]
#[must_use = "call open"]
pub struct OpenRemote {
    uri: String,
    name: String,
    space: Option<Space>,
    payload_encoding: PayloadEncoding,
    timeout: Duration,
    latest: bool,
    credentials: Credentials,
}

impl OpenRemote {
    pub(in crate::index) fn new(uri: &str, name: &str) -> OpenRemote {
        OpenRemote {
            uri: uri.to_owned(),
            name: name.to_owned(),
            space: None,
            payload_encoding: PayloadEncoding::Unspecified,
            timeout: Duration::from_secs(30),
            latest: false,
            credentials: Credentials::default(),
        }
    }

    /// Creates the index with this space if it is missing. An index with another space is refused.
    pub fn create(mut self, space: &Space) -> OpenRemote {
        self.space = Some(space.clone());
        self
    }

    /// How the payloads of an index that is created here hold edges: nothing is declared unless set. An index that
    /// declares another encoding is refused; one that declares nothing is opened ([`Index::payload_encoding`] tells).
    pub fn payload_encoding(mut self, encoding: PayloadEncoding) -> OpenRemote {
        self.payload_encoding = encoding;
        self
    }

    /// The longest time of a call: 30 s unless set.
    pub fn timeout(mut self, timeout: Duration) -> OpenRemote {
        self.timeout = timeout.min(MAX_WAIT);
        self
    }

    /// Its searches, gets and scans see all that any server of a cluster acknowledged before (see
    /// [`IndexHandle::latest`](crate::IndexHandle::latest)). Unless set, they see the caller's own writes, and may lag behind
    /// those of others.
    pub fn latest(mut self) -> OpenRemote {
        self.latest = true;
        self
    }

    /// The certificates and the token of the connection: none unless set.
    pub fn credentials(mut self, credentials: Credentials) -> OpenRemote {
        self.credentials = credentials;
        self
    }

    /// Connects to the first server that answers, and opens the index.
    ///
    /// # Errors
    /// [`Error::Address`], [`Error::Connection`], [`Error::Timeout`]. `NOT_FOUND`: there is no index of this name.
    /// `ALREADY_EXISTS`: it has another space or encoding.
    /// Those of [`ClientBuilder::connect`](crate::ClientBuilder::connect), [`Error::Forked`], [`Error::Thread`],
    /// [`Error::Interrupted`], and every refusal of the server.
    pub fn open(self) -> Result<Index, Error> {
        let index = wait_for(async move {
            let client = Client::builder().timeout(self.timeout);
            let client = client.credentials(self.credentials);
            let client = client.connect(&self.uri).await?;
            let index = match &self.space {
                Some(space) => {
                    let declared = self.payload_encoding;
                    client.create_index_with(&self.name, space, declared).await
                }
                None => client.index(&self.name).await,
            }?;
            Ok(match self.latest {
                true => index.latest(),
                false => index,
            })
        })?;
        Ok(Index {
            payload_encoding: index.payload_encoding(),
            ..Index::of(Arc::new(Remote { index }))
        })
    }
}
