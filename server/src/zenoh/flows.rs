//! The flows of the links: queries that are read from one link share the server's time and memory.

use std::{
    collections::HashMap,
    sync::{Arc, Weak},
};

use parking_lot::Mutex;
use tokio::task;

use crate::admission::{Admission, Flow};

/// See the module.
pub(super) struct Flows {
    admission: Admission,
    /// By the task of Zenoh's that reads the link; None for queries of this process.
    open: Mutex<HashMap<Option<task::Id>, Weak<Flow>>>,
}

impl Flows {
    pub(super) fn new(admission: Admission) -> Self {
        let open = Mutex::default();
        Self { admission, open }
    }

    /// The flow of the query that this task has just read.
    pub(super) fn of_reader(&self) -> Arc<Flow> {
        let mut open = self.open.lock();
        let reader = task::try_id();
        if let Some(flow) = open.get(&reader).and_then(Weak::upgrade) {
            return flow;
        }
        // A flow ends with its last query, and a link has few flows one after the other under load.
        open.retain(|_, flow| flow.strong_count() > 0);
        let flow = self.admission.open();
        open.insert(reader, Arc::downgrade(&flow));
        flow
    }
}
