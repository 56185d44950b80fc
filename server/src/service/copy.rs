//! Gives other members of the cluster copies of indices.

use std::sync::Arc;

use tokio::sync::OwnedSemaphorePermit;

use super::{
    Call, Error, Service, Snapshot,
    error_map::registry_error,
    member::{CopyKind, CopyOperation, CopyOperations, CopyPart, CopyRequest, CopyStart},
};
use crate::{log::Operation, registry::Published};

/// Copies that are given at a time. Each holds a revision.
pub(super) const MAX_COPIES: usize = 2;

/// Approximate bytes of a part with operations.
const PART_BYTES: usize = 256 * 1024;

/// A copy that is given to another member, part by part. It pins its revision until it ends, is dropped, or its time is up.
pub struct IndexCopy {
    start: Option<CopyStart>,
    snapshot: Snapshot,
    /// The operations that are yet to be sent.
    operations: std::vec::IntoIter<Arc<Operation>>,
    _turn: OwnedSemaphorePermit,
}

/// The answer to a member that asks for a copy.
pub enum CopyOutcome {
    /// The copy.
    Copy(Box<IndexCopy>),
    /// The reason why there is none.
    None(CopyKind),
}

impl Service {
    /// Begins to give another member a copy of an index, if this server has what that member lacks, and the same before it.
    pub(crate) async fn copy_index(&self, request: CopyRequest) -> Result<CopyOutcome, Error> {
        let refused = |why: &str| Ok(CopyOutcome::None(CopyKind::Refused(why.to_owned())));
        if !self.is_serving() {
            return refused("it starts or stops");
        }
        let Ok(turn) = Arc::clone(&self.inner.copies).try_acquire_owned() else {
            return refused("it gives copies to others");
        };
        let hosted = match request.uid.parse() {
            Ok(uid) => self.registry()?.by_uid(uid),
            Err(_) => None,
        };
        let Some(hosted) = hosted else {
            return refused("it does not serve the index");
        };
        // Its history may differ from the journal's, and a server with its copy would stop at the same record.
        if hosted.is_closed() {
            return refused("it has stopped following the journal itself");
        }
        let applied = match &request.applied {
            Some(place) => match place.position() {
                Some(position) => Some(position),
                None => return refused("the request names no digest"),
            },
            None => None,
        };
        let reading = Arc::clone(&hosted);
        let read = tokio::task::spawn_blocking(move || {
            let (published, operations) = reading.with_operations()?;
            let digest = match applied {
                Some(applied) => reading.digest_at(applied.revision)?,
                None => None,
            };
            Ok((published, operations, digest))
        });
        let read = read.await.map_err(|_| Error::Internal {
            what: "the task that begins a copy panicked".into(),
        })?;
        let (published, operations, digest): (Arc<Published>, Vec<_>, _) =
            read.map_err(|error| registry_error(hosted.name(), error))?;
        if let Some((applied, digest)) = applied.zip(digest)
            && applied.digest != digest
        {
            return Ok(CopyOutcome::None(CopyKind::Contradicts(applied.revision)));
        }
        let needed = applied.map_or(0, |applied| applied.revision);
        let needed = needed.max(request.min_revision);
        if published.revision < needed {
            let revision = published.revision;
            let why = format!("it is at revision {revision}, and {needed} is needed");
            return refused(&why);
        }
        let start = CopyStart {
            position: Some(published.view.position().into()),
            operations: operations.len() as u64,
            is_compared: digest.is_some(),
        };
        Ok(CopyOutcome::Copy(Box::new(IndexCopy {
            start: Some(start),
            snapshot: Snapshot::of(self.limits(), Call::default(), hosted, published),
            operations: operations.into_iter(),
            _turn: turn,
        })))
    }
}

impl IndexCopy {
    /// The next part; None after the last or an error.
    pub(crate) async fn next(&mut self) -> Option<Result<CopyPart, Error>> {
        let kind = if let Some(start) = self.start.take() {
            Ok(CopyKind::Start(start))
        } else if let Some(part) = self.snapshot.next_part().await {
            part.map(CopyKind::Snapshot)
        } else {
            Ok(CopyKind::Operations(self.operations()?))
        };
        if kind.is_err() {
            self.operations = Vec::new().into_iter();
        }
        Some(kind.map(|kind| CopyPart { kind: Some(kind) }))
    }

    /// The next operations; None if there are no more.
    fn operations(&mut self) -> Option<CopyOperations> {
        let (mut page, mut bytes) = (Vec::new(), 0);
        while bytes < PART_BYTES
            && let Some(operation) = self.operations.next()
        {
            bytes += operation.bytes();
            page.push(CopyOperation::from(&*operation));
        }
        (!page.is_empty()).then_some(CopyOperations { operations: page })
    }
}
