//! `CreateIndex`, `GetIndex`, `ListIndexes`, `DeleteIndex`.

use std::sync::Arc;

use prost::Message;
use tokio_util::task::AbortOnDropHandle;
use tracing::Span;
use wayfold_index::Space;
use wayfold_proto::{
    space,
    v1::{self, PayloadEncoding, create_index_request::SpaceForm},
};

use super::{
    Call, Error, Service,
    check::Violations,
    error_map::{catalog_error, registry_error},
    read_view::{revision, unknown},
};
use crate::{
    identity::{Caller, Role},
    log::{MAX_NAME_BYTES, Uid},
    registry::{Hosted, IndexLimit, IndexState, Published, RegistryError},
};

/// A page of the indices, by name. Both lists together are consecutive.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Listing {
    /// Readable indices.
    pub indexes: Vec<v1::Index>,
    /// Damaged indices.
    pub damaged: Vec<Damaged>,
    /// Asks for the next page; empty on the last.
    pub next_page_token: String,
}

/// An index that cannot be read, or not written.
#[derive(Clone, Debug, PartialEq)]
pub struct Damaged {
    /// Its name.
    pub name: String,
    /// Its uid.
    pub uid: String,
    /// The error of every call for it, or of its mutations if it can be read.
    pub error: Error,
}

impl Damaged {
    /// An upper bound of its bytes in an answer.
    fn bytes(&self) -> usize {
        // The answer holds the error's code, reason, names and text.
        const FIELD_BYTES: usize = 256;
        FIELD_BYTES + self.name.len() + self.uid.len() + self.error.to_string().len()
    }
}

/// The refusal of an index beyond a limit on their number.
pub(super) fn too_many_indexes(limit: &'static str, max: usize) -> Error {
    Error::LimitExceeded {
        limit,
        value: max as u64,
        requested: max as u64 + 1,
        advice: "delete an index first, or wait for a restore that is under way",
    }
}

impl Service {
    /// The limits on the number of indices, for one that the caller adds.
    pub(super) fn index_limits(&self, caller: &Caller) -> Vec<IndexLimit> {
        let mut limits = vec![IndexLimit {
            setting: "max_indexes",
            max: self.limits().max_indexes,
            counts: Arc::new(|_| true),
        }];
        if let Some(max) = caller.max_indexes() {
            let caller = caller.clone();
            limits.push(IndexLimit {
                setting: "max_indexes of the identity",
                max,
                counts: Arc::new(move |name| caller.sees(name)),
            });
        }
        limits
    }

    /// Creates an index, or finds the one of this name with an equal space.
    pub async fn create_index(
        &self,
        call: &Call,
        request: v1::CreateIndexRequest,
    ) -> Result<v1::CreateIndexResponse, Error> {
        // A reader finds an index that exists. Only an admin creates one.
        let refused = self.accept(call, Role::Admin, Some(&request.name)).err();
        if let Some(refused) = &refused
            && self.index(call, Role::Read, &request.name, "").is_err()
        {
            return Err(refused.clone());
        }
        let mut violations = Violations::default();
        check_name(&request.name, &mut violations);
        let space = read_space(request.space_form, &mut violations);
        let declared = PayloadEncoding::try_from(request.payload_encoding);
        if declared.is_err() {
            let text = format!(
                "{} is no value of PayloadEncoding",
                request.payload_encoding
            );
            violations.add("payload_encoding", "UNKNOWN_VALUE", text);
        }
        violations.finish()?;
        let (Some(space), Ok(payload_encoding)) = (space, declared) else {
            return Err(Error::Internal {
                what: "a request that was refused without a reason".into(),
            });
        };
        // An index that exists is found at once: creating one may wait long for NATS, and holds up other changes.
        let found = self
            .registry()?
            .find(&request.name, &space, payload_encoding);
        let created = match found {
            Ok(None) if refused.is_none() => {
                let (name, limits) = (request.name.clone(), self.index_limits(&call.caller));
                let create = move |service: &Service| {
                    let registry = service.registry()?;
                    Ok::<_, Error>(registry.create(&name, space, payload_encoding, &limits))
                };
                self.change(call, create).await??
            }
            Ok(found) => found.map(|it| (it, false)).ok_or(RegistryError::Deleted),
            Err(error) => Err(error),
        };
        let (hosted, created) = created.map_err(|error| match (error, refused) {
            (RegistryError::Deleted, Some(refused)) => refused,
            (
                RegistryError::Exists {
                    what,
                    existing,
                    requested,
                },
                _,
            ) => Error::IndexExists {
                name: request.name.clone(),
                what,
                existing,
                requested,
            },
            (RegistryError::TooManyIndexes { setting, max }, _) => too_many_indexes(setting, max),
            (error, _) => registry_error(&request.name, error),
        })?;
        Ok(v1::CreateIndexResponse {
            index: Some(describe(&hosted, &hosted.published())),
            created,
        })
    }

    /// Describes one index.
    pub async fn get_index(
        &self,
        call: &Call,
        request: v1::GetIndexRequest,
    ) -> Result<v1::GetIndexResponse, Error> {
        let hosted = self.index(call, Role::Read, &request.index_name, "")?;
        Ok(v1::GetIndexResponse {
            index: Some(describe(&hosted, &hosted.published())),
        })
    }

    /// Lists the indices in the order of their names, one page a call, damaged ones included. A page ends before the
    /// answer exceeds its limit.
    pub async fn list_indexes(
        &self,
        call: &Call,
        request: v1::ListIndexesRequest,
    ) -> Result<Listing, Error> {
        self.accept(call, Role::Read, None)?;
        let size = match request.page_size {
            0 => 100,
            size => size.min(1000) as usize,
        };
        let mut violations = Violations::default();
        let after = read_token(&request.page_token, &mut violations);
        violations.finish()?;

        let mut pace = call.pace("while listing the indices");
        // The token of the next page names the last index, so that it must be one that the caller may see.
        let seen = |name: &str| call.caller.sees(name);
        let listed = self.registry()?.page(after.as_deref(), size + 1, seen);
        let listed = listed.map_err(catalog_error)?;
        let mut page = Listing::default();
        let (mut bytes, mut last) = (0, None::<String>);
        for (at, (name, state)) in listed.into_iter().enumerate() {
            let damaged = |uid: Uid, why| Damaged {
                name: name.clone(),
                uid: uid.to_string(),
                error: registry_error(&name, why),
            };
            let entry = match state {
                IndexState::Hosted(hosted) => match hosted.problem() {
                    Some(why) => Err(damaged(hosted.uid(), why)),
                    None => Ok(describe(&hosted, &hosted.published())),
                },
                IndexState::Damaged(uid, why) => Err(damaged(uid, why)),
            };
            bytes += match &entry {
                Ok(index) => index.encoded_len() + 8,
                Err(damaged) => damaged.bytes(),
            };
            let full = at == size || bytes > self.limits().max_answer_bytes;
            if let Some(last) = last.filter(|_| full) {
                page.next_page_token = hex::encode(&last);
                break;
            }
            match entry {
                Ok(index) => page.indexes.push(index),
                Err(damaged) => page.damaged.push(damaged),
            }
            last = Some(name);
            pace.step().await?;
        }
        Ok(page)
    }

    /// Deletes an index and all its points.
    pub async fn delete_index(
        &self,
        call: &Call,
        request: v1::DeleteIndexRequest,
    ) -> Result<v1::DeleteIndexResponse, Error> {
        self.accept(call, Role::Admin, Some(&request.index_name))?;
        let (name, uid) = (request.index_name.clone(), request.uid.clone());
        let delete = move |service: &Service| {
            let uid = Some(&*uid).filter(|uid| !uid.is_empty());
            Ok::<_, Error>(service.registry()?.delete(&name, uid))
        };
        let deleted = self.change(call, delete).await??;
        let uid = deleted.map_err(|error| match error {
            RegistryError::OtherUid { found } => Error::UidMismatch {
                index: request.index_name.clone(),
                requested: request.uid.clone(),
                found: found.to_string(),
            },
            RegistryError::UnknownUid => unknown(&request.index_name, &request.uid),
            error => registry_error(&request.index_name, error),
        })?;
        Ok(v1::DeleteIndexResponse {
            uid: uid.to_string(),
        })
    }

    /// Creates, deletes or restores on a thread that may block. A change that waits for its thread does not begin once its
    /// caller has left; one that has begun completes.
    pub(super) async fn change<T: Send + 'static>(
        &self,
        call: &Call,
        change: impl FnOnce(&Service) -> T + Send + 'static,
    ) -> Result<T, Error> {
        let waiting = async {
            let all = Arc::clone(&self.inner.changes).acquire_owned();
            match &call.permits {
                // The other changes of a client wait there, not in the queue of all.
                Some(permits) => permits.change(all).await,
                None => (None, all.await),
            }
        };
        let doing = "while waiting for changes of other indices; nothing was changed";
        let permits = call.bound(doing, waiting).await?;
        // The wait may have been long.
        call.check(doing)?;
        let service = self.clone();
        // The lines of the change have the caller's identity.
        let span = Span::current();
        let changing = tokio::task::spawn_blocking(move || {
            // The change of a caller that has left keeps its permits until it ends.
            let _permits = permits;
            let _entered = span.enter();
            change(&service)
        });
        // The join fails only if the work panicked.
        let changed = AbortOnDropHandle::new(changing).await;
        changed.map_err(|_| Error::Internal {
            what: "the task that creates, deletes or restores an index panicked".into(),
        })
    }
}

/// Describes an index at one published revision.
pub(super) fn describe(hosted: &Hosted, published: &Published) -> v1::Index {
    let space = hosted.space();
    v1::Index {
        name: hosted.name().into(),
        space: Some(space::to_message(space)),
        space_text: space.to_string(),
        revision: Some(revision(hosted, published.revision)),
        point_count: published.snapshot.len() as u64,
        coordinate_count: space.coordinates() as u32,
        dimension: space.dimension() as u32,
        memory_bytes: published.snapshot.memory_bytes() as u64,
        payload_encoding: hosted.payload_encoding().into(),
    }
}

/// Names are `[a-z0-9][a-z0-9_-]{0,62}`.
fn is_name(name: &str) -> bool {
    let word = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit();
    let rest = |byte: u8| word(byte) || byte == b'_' || byte == b'-';
    name.len() <= MAX_NAME_BYTES && name.bytes().next().is_some_and(word) && name.bytes().all(rest)
}

pub(super) fn check_name(name: &str, violations: &mut Violations) {
    if !is_name(name) {
        let text = format!("{name:?} is not of the form [a-z0-9][a-z0-9_-]{{0,62}}");
        violations.add("name", "NAME", text);
    }
}

/// The space, from either form; `None` after a violation.
fn read_space(form: Option<SpaceForm>, violations: &mut Violations) -> Option<Space> {
    let (field, problem) = match form {
        None => {
            violations.add("space", "REQUIRED", "set space or space_text");
            return None;
        }
        Some(SpaceForm::Space(message)) => match space::from_message(&message) {
            Ok(space) => return Some(space),
            Err(error) => (format!("space.{}", error.path), error.problem.to_string()),
        },
        Some(SpaceForm::SpaceText(text)) => match text.parse::<Space>() {
            Ok(space) => return Some(space),
            Err(error) => ("space_text".to_owned(), error.to_string()),
        },
    };
    violations.add(field, "SPACE", problem);
    None
}

/// Reads a page token: the last name of the page before, in hexadecimal. It is opaque, and good even if that index is gone.
fn read_token(token: &str, violations: &mut Violations) -> Option<String> {
    if token.is_empty() {
        return None;
    }
    let bytes = hex::decode(token).ok();
    let name = bytes
        .and_then(|bytes| String::from_utf8(bytes).ok())
        .filter(|name| is_name(name));
    if name.is_none() {
        violations.add(
            "page_token",
            "PAGE_TOKEN",
            "not a token of this server: send next_page_token of the page before, or nothing",
        );
    }
    name
}

#[cfg(test)]
mod tests;
