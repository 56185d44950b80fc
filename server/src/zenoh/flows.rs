//! The flows of the links: queries that are read from one link share the server's time and memory.

use std::{collections::HashMap, sync::Arc};

use parking_lot::Mutex;
use tokio::task;

use crate::admission::{Admission, Flow};

/// See the module.
pub(super) struct Flows {
    admission: Admission,
    /// By the task of Zenoh's that reads the link; None for queries of this process.
    open: Mutex<HashMap<Option<task::Id>, Arc<Flow>>>,
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
        if let Some(flow) = open.get(&reader) {
            return Arc::clone(flow);
        }
        // An idle flow ends here: nothing tells of a link that has closed.
        open.retain(|_, flow| is_in_use(flow));
        let flow = self.admission.open();
        open.insert(reader, Arc::clone(&flow));
        flow
    }
}

/// True if a query has the flow, or that of its calls of administration, or a held scan knows its caller by it: these two
/// do not keep it.
fn is_in_use(flow: &Arc<Flow>) -> bool {
    Arc::strong_count(flow) > 1 || Arc::strong_count(flow.admin()) > 1 || flow.has_permits()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[tokio::test]
    async fn calls_of_administration_and_held_scans_keep_the_flow_of_their_link() {
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let flows = Arc::new(Flows::new(admission));
        let open_another = || {
            let flows = Arc::clone(&flows);
            tokio::spawn(async move { drop(flows.of_reader()) })
        };
        let list = flows.of_reader().admin().hold();
        open_another().await.unwrap();
        assert!(Arc::ptr_eq(list.flow(), flows.of_reader().admin()));
        drop(list);
        let scan = flows.of_reader().permits();
        open_another().await.unwrap();
        assert!(Arc::ptr_eq(&scan, &flows.of_reader().permits()));
        drop(scan);
        open_another().await.unwrap();
        assert_eq!(flows.open.lock().len(), 1);
    }
}
