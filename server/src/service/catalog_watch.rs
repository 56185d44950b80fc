//! A watch on the set of served indices, for a face that announces each of them.

use std::collections::BTreeMap;

use tokio::sync::watch;

use super::{Error, Service, error_map::catalog_error};
use crate::registry::IndexState;

/// Follows the set of served indices.
pub struct CatalogWatch {
    service: Service,
    changes: watch::Receiver<()>,
}

impl Service {
    /// Begins to follow the set of served indices; fails while there is no registry.
    pub fn watch_catalog(&self) -> Result<CatalogWatch, Error> {
        let mut changes = self.registry()?.changes();
        // The first change is the present set.
        changes.mark_changed();
        Ok(CatalogWatch {
            service: self.clone(),
            changes,
        })
    }
}

impl CatalogWatch {
    /// Waits for a possible change; returns the uids of readable indices by name. The first call returns at once.
    pub async fn changed(&mut self) -> Result<BTreeMap<String, String>, Error> {
        // The sender is in the registry, which the service holds.
        let _ = self.changes.changed().await;
        match self.service.registry()?.page(None, usize::MAX, |_| true) {
            Ok(listed) => Ok(listed.into_iter().filter_map(hosted).collect()),
            Err(error) => Err(catalog_error(error)),
        }
    }
}

fn hosted((name, state): (String, IndexState)) -> Option<(String, String)> {
    let hosted = state.hosted().ok()?;
    Some((name, hosted.uid_text().into()))
}
