//! The part of a copy that has arrived.

use std::sync::Arc;

use wayfold_proto::{
    snapshot::{Content, Header, Reader},
    v1,
};

use super::{Failure, out_of_order};
use crate::{
    log::{Operation, Origin, RecordPosition, Sessions, Uid},
    registry::{Restore, Stopped},
    service::{
        Service,
        member::{CopyKind, CopyOperations},
        restore::stored,
        session_pages::{add_restored, memory_bytes},
    },
};

/// See the module.
pub(super) struct CopyDraft {
    service: Service,
    uid: Uid,
    position: RecordPosition,
    /// The newest record of the index that the member has compared, if it is served.
    compared: Option<RecordPosition>,
    reader: Reader,
    /// Set by the header.
    restore: Option<Restore>,
    sessions: Sessions,
    operations: Vec<Arc<Operation>>,
}

impl CopyDraft {
    /// Nothing has arrived of a copy of this index, whose newest record is at `position`.
    pub(super) fn new(service: &Service, index: &Stopped, position: RecordPosition) -> Self {
        Self {
            service: service.clone(),
            uid: index.uid,
            position,
            compared: index.position,
            reader: Reader::new(),
            restore: None,
            sessions: Sessions::default(),
            operations: Vec::new(),
        }
    }

    /// True if it has all points and sessions, and this many operations.
    pub(super) fn is_whole(&self, operations: u64) -> bool {
        self.reader.is_done() && self.operations.len() as u64 >= operations
    }

    /// Adds the next part. Blocks.
    pub(super) fn read(&mut self, part: CopyKind) -> Result<(), Failure> {
        match part {
            CopyKind::Snapshot(part) => self.read_snapshot(&part),
            CopyKind::Operations(page) if self.reader.is_done() => self.remember(page),
            _ => Err(out_of_order()),
        }
    }

    fn read_snapshot(&mut self, part: &v1::SnapshotPart) -> Result<(), Failure> {
        match (self.reader.read(part)?, &mut self.restore) {
            (Content::Header(header), None) => self.begin(&header),
            (Content::Points(points, modified), Some(restore)) => {
                Ok(restore.add(&stored(points, &modified))?)
            }
            (Content::Sessions(sessions), Some(restore)) => {
                restore.admit(memory_bytes(&sessions))?;
                let limits = self.service.limits();
                Ok(add_restored(&mut self.sessions, sessions, limits)?)
            }
            (Content::Trailer, Some(_)) => Ok(()),
            // The reader refuses these.
            _ => Err(out_of_order()),
        }
    }

    fn begin(&mut self, header: &Header) -> Result<(), Failure> {
        if header.uid != self.uid.to_string() || header.revision != self.position.revision {
            return Err(Failure::Other("its copy is that of another index".into()));
        }
        let origin = Origin {
            revision: header.revision,
            next_id: header.next_id,
            digest: self.position.digest,
        };
        let restore = self.service.registry()?.replace(self.uid, origin)?;
        if *restore.space() != header.space {
            return Err(Failure::Other("its copy has another space".into()));
        }
        self.restore = Some(restore);
        Ok(())
    }

    fn remember(&mut self, page: CopyOperations) -> Result<(), Failure> {
        for operation in page.operations {
            let operation = operation.operation().ok_or_else(out_of_order)?;
            self.operations.push(Arc::new(operation));
        }
        Ok(())
    }

    /// Puts the copy in the place of the index. Blocks.
    pub(super) fn host(self) -> Result<(), Failure> {
        let restore = self.restore.ok_or_else(out_of_order)?;
        let registry = self.service.registry()?;
        registry.host_replaced(restore, self.compared, self.sessions, self.operations)?;
        Ok(())
    }
}
