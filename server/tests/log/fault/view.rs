//! The views of a log that fails on demand.

use std::{collections::BTreeMap, sync::Arc};

use wayfold_server::log::{LogError, Record, RecordPosition, Sessions, StoredPoint, View};

use super::{
    FaultLog,
    journal::{Journal, Sum},
};

impl FaultLog {
    pub(super) fn view_of(&self, journal: &Journal, record: &Record, sum: Arc<Sum>) -> PinnedView {
        PinnedView {
            log: self.clone(),
            opened: journal.opened,
            position: record.position(),
            sum,
        }
    }
}

/// A view. It ends when the log is reopened.
pub(super) struct PinnedView {
    pub(super) log: FaultLog,
    pub(super) opened: u64,
    pub(super) position: RecordPosition,
    pub(super) sum: Arc<Sum>,
}

impl PinnedView {
    fn points(&self) -> Result<&BTreeMap<u64, Arc<StoredPoint>>, LogError> {
        self.log.1.pass();
        match self.log.0.lock().opened == self.opened {
            true => Ok(&self.sum.points),
            false => Err(LogError::Closed),
        }
    }
}

impl View for PinnedView {
    fn position(&self) -> RecordPosition {
        self.position
    }

    fn next_id(&self) -> u64 {
        self.sum.next_id
    }

    fn sessions(&self) -> &Sessions {
        &self.sum.sessions
    }

    fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError> {
        Ok(self.points()?.get(&id).cloned())
    }

    fn page(&self, after: Option<u64>, limit: usize) -> Result<Vec<Arc<StoredPoint>>, LogError> {
        let points = self.points()?.iter();
        let later = points.filter(|(id, _)| after.is_none_or(|after| **id > after));
        Ok(later
            .take(limit)
            .map(|(_, point)| Arc::clone(point))
            .collect())
    }
}
