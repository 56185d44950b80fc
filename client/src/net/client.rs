//! The connection to a server, and the calls about whole indices.

mod builder;
mod calls;
mod health;

use std::{
    fmt,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use tokio::time::Instant;
use tonic::Code;
use wayfold_index::Space;
use wayfold_proto::{
    space,
    v1::{self, PayloadEncoding, create_index_request::SpaceForm},
};

pub use self::builder::ClientBuilder;
pub(crate) use self::calls::within;
use super::{
    call::Call,
    connections::{Connection, Connections},
    newest::{Newest, NewestRevisions},
};
use crate::{
    DamagedIndex, Error, IndexHandle, IndexInfo, IndexList, Limits, RetryPolicy, Revision,
    ServerInfo,
};

/// A connection to a Wayfold server, or to several that share their indices. Clones share it; any number of calls can
/// be under way on it at once.
///
/// The next call restores a broken connection, or goes to another server.
#[derive(Clone)]
pub struct Client {
    connections: Arc<Connections>,
    uri: Arc<str>,
    settings: ClientBuilder,
    /// The limits by which requests are divided; `None` until a request needs them.
    limits: Arc<Mutex<Option<Limits>>>,
    /// The newest revisions that any answer named, if there are several servers.
    newest: Arc<NewestRevisions>,
}

impl Client {
    /// Connects with the default settings to a server, or to the first of several that answers: `uri` names them with
    /// commas between them. See [`ClientBuilder::connect`].
    ///
    /// # Errors
    /// The errors of [`ClientBuilder::connect`].
    pub async fn connect(uri: &str) -> Result<Client, Error> {
        Client::builder().connect(uri).await
    }

    /// Settings to connect with.
    pub fn builder() -> ClientBuilder {
        ClientBuilder::default()
    }

    /// The server's address; of several, all of them with commas between them.
    pub fn uri(&self) -> &str {
        &self.uri
    }

    /// The server's version, durability and limits.
    ///
    /// # Errors
    /// Those of every call.
    pub async fn server(&self) -> Result<ServerInfo, Error> {
        self.server_for("get_server", self.settings.timeout).await
    }

    /// Returns the result of [`Client::server`] on behalf of `call`, which an error names.
    async fn server_for(&self, call: &'static str, timeout: Duration) -> Result<ServerInfo, Error> {
        let attempt = |connection, remaining| {
            Call::send(connection, within(remaining, v1::GetServerRequest {}))
        };
        ServerInfo::from_message(call, self.call(call, timeout, attempt).await?)
    }

    /// The server's limits. The client requests them when it first needs them, and again after the server has named a
    /// lower one, for example after a restart.
    pub(crate) async fn limits(
        &self,
        call: &'static str,
        timeout: Duration,
    ) -> Result<Limits, Error> {
        let known = *self.known_limits();
        match known {
            Some(limits) => Ok(limits),
            None => {
                let limits = self.server_for(call, timeout).await?.limits;
                Ok(*self.known_limits().insert(limits))
            }
        }
    }

    fn known_limits(&self) -> MutexGuard<'_, Option<Limits>> {
        self.limits.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Creates an index, or opens the one that exists with an equal space.
    ///
    /// # Errors
    /// `ALREADY_EXISTS`: the index has another space. `INVALID_ARGUMENT`: the name. `RESOURCE_EXHAUSTED`: the server
    /// holds its maximum number of indices, or as many as this identity may have, or its memory or disk is above its
    /// watermark.
    pub async fn create_index(&self, name: &str, space: &Space) -> Result<IndexHandle, Error> {
        self.create_index_with(name, space, PayloadEncoding::Unspecified)
            .await
    }

    /// Acts like [`Client::create_index`]; a new index declares how its payloads hold edges.
    ///
    /// # Errors
    /// The errors of [`Client::create_index`]. `ALREADY_EXISTS`: the index declares another encoding.
    pub async fn create_index_with(
        &self,
        name: &str,
        space: &Space,
        payload_encoding: PayloadEncoding,
    ) -> Result<IndexHandle, Error> {
        let (info, _created) = self.ensure_index(name, space, payload_encoding).await?;
        Ok(IndexHandle::new(self.clone(), info))
    }

    /// Acts like [`Client::create_index_with`], but returns the description, and true if this call created the index.
    ///
    /// # Errors
    /// The errors of [`Client::create_index_with`].
    pub async fn ensure_index(
        &self,
        name: &str,
        space: &Space,
        payload_encoding: PayloadEncoding,
    ) -> Result<(IndexInfo, bool), Error> {
        const CALL: &str = "create_index";
        let message = v1::CreateIndexRequest {
            name: name.to_owned(),
            space_form: Some(SpaceForm::Space(space::to_message(space))),
            payload_encoding: payload_encoding.into(),
        };
        let answer = self.send(self.settings.timeout, &message).await?;
        let info = IndexInfo::from_message(CALL, answer.index)?;
        match self.is_newest(&info) {
            true => Ok((info, answer.created)),
            false => Ok((self.index_info(name).await?, false)),
        }
    }

    /// Opens an index that exists.
    ///
    /// # Errors
    /// `NOT_FOUND`: there is no index of this name.
    pub async fn index(&self, name: &str) -> Result<IndexHandle, Error> {
        Ok(IndexHandle::new(self.clone(), self.index_info(name).await?))
    }

    /// Describes an index.
    ///
    /// # Errors
    /// `NOT_FOUND`: there is no index of this name.
    pub async fn index_info(&self, name: &str) -> Result<IndexInfo, Error> {
        self.index_info_within(name, self.settings.timeout).await
    }

    /// Acts like [`Client::index_info`], with another timeout.
    pub(crate) async fn index_info_within(
        &self,
        name: &str,
        timeout: Duration,
    ) -> Result<IndexInfo, Error> {
        const CALL: &str = "get_index";
        let deadline = Instant::now() + timeout;
        let request = v1::GetIndexRequest {
            index_name: name.to_owned(),
        };
        let mut awaited: Option<Revision> = None;
        loop {
            let attempt =
                |connection, remaining| Call::send(connection, within(remaining, request.clone()));
            let (answer, _) = self.call_at(CALL, timeout, deadline, attempt).await?;
            let info = IndexInfo::from_message(CALL, answer.index)?;
            // Revisions that other calls have seen since the first answer do not count: more may always come.
            let seen = || self.newest(&info.revision).number();
            let awaited_here = awaited.filter(|it| it.uid == info.revision.uid);
            let newest = awaited_here.map_or_else(seen, |it| it.number);
            if newest <= info.revision.number {
                return Ok(info);
            }
            awaited = Some(Revision::new(Arc::clone(info.uid()), newest));
            // This server lags behind another one.
            let index = IndexHandle::new(self.clone(), info).with_timeout(timeout);
            let mut attempts = 0;
            let attempt = |connection: Connection, remaining| {
                attempts += 1;
                let (index, patience) = (&index, self.patience(timeout, attempts));
                async move {
                    let waited = index.wait_for_newest(&connection, remaining, patience);
                    let waited = waited.await;
                    waited.map(tonic::Response::new)
                }
            };
            self.call_at(CALL, timeout, deadline, attempt).await?;
        }
    }

    /// False if the client has seen a newer revision of the index.
    fn is_newest(&self, info: &IndexInfo) -> bool {
        self.newest(&info.revision).number() <= info.revision.number
    }

    /// The newest revision of the uid that any answer named to this client, if there are several servers: they may lag
    /// behind each other. This one is the first if there is only one.
    pub(crate) fn newest(&self, revision: &Revision) -> Arc<Newest> {
        match self.connections.are_several() {
            true => self.newest.of(revision),
            false => Arc::new(Newest::new(revision.number)),
        }
    }

    /// All indices of the server, by name; the damaged ones in a list of their own.
    ///
    /// # Errors
    /// Those of every call.
    pub async fn list_indexes(&self) -> Result<IndexList, Error> {
        const CALL: &str = "list_indexes";
        let (mut list, mut page_token) = (IndexList::default(), String::new());
        loop {
            let message = v1::ListIndexesRequest {
                page_size: 0,
                page_token,
            };
            let page = self.send(self.settings.timeout, &message).await?;
            for index in page.indexes {
                let info = IndexInfo::from_message(CALL, Some(index))?;
                list.indexes.push(match self.is_newest(&info) {
                    true => info,
                    false => self.index_info(&info.name).await?,
                });
            }
            list.damaged
                .extend(page.damaged.into_iter().map(DamagedIndex::from_message));
            page_token = page.next_page_token;
            if page_token.is_empty() {
                return Ok(list);
            }
        }
    }

    /// Deletes the index that has this name now, with all its points, and returns the uid it had. A damaged index can
    /// be deleted too, and one that is not loaded for lack of memory.
    ///
    /// # Errors
    /// `NOT_FOUND`: there is no index of this name. `FAILED_PRECONDITION`: it was created again during the call.
    pub async fn delete_index(&self, name: &str) -> Result<String, Error> {
        // With its uid, a retried delete cannot hit an index that was created in between.
        let mut once = self.clone();
        once.settings.retry = RetryPolicy::never();
        let uid = match once.index_info(name).await {
            Ok(index) => index.revision.uid.to_string(),
            Err(error) if error.code() != Code::DataLoss && !error.is_transient() => {
                return Err(error);
            }
            // A server of a cluster answers `UNAVAILABLE` for an index that it cannot read.
            Err(error) => match self.damaged_uid(name).await? {
                Some(uid) => uid,
                None if error.is_transient() => {
                    self.index_info(name).await?.revision.uid.to_string()
                }
                None => return Err(error),
            },
        };
        let message = v1::DeleteIndexRequest {
            index_name: name.to_owned(),
            uid: uid.clone(),
        };
        match self.send(self.settings.timeout, &message).await {
            // The index existed before this call: an earlier attempt or another caller deleted it.
            Err(error) if error.code() == Code::NotFound => {}
            deleted => drop(deleted?),
        }
        self.newest.forget(&uid);
        Ok(uid)
    }

    /// The uid of the index of this name, if it is damaged.
    async fn damaged_uid(&self, name: &str) -> Result<Option<String>, Error> {
        let damaged = self.list_indexes().await?.damaged.into_iter();
        let mut named = damaged.filter(|damaged| damaged.name == name);
        Ok(named.next().map(|damaged| damaged.uid))
    }

    /// The connection that the next call uses.
    pub(crate) fn connection(&self) -> Connection {
        self.connections.current()
    }

    pub(crate) fn connections(&self) -> &Connections {
        &self.connections
    }

    pub(crate) fn timeout(&self) -> Duration {
        self.settings.timeout
    }

    pub(crate) fn retry_policy(&self) -> RetryPolicy {
        self.settings.retry
    }

    pub(crate) fn max_message_bytes(&self) -> usize {
        self.settings.max_message_bytes
    }
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Client")
            .field("uri", &self.uri)
            .field("settings", &self.settings)
            .finish_non_exhaustive()
    }
}
