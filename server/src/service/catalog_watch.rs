//! Which indices are served: for a face that has something to announce for each.

use std::collections::BTreeMap;

use tokio::sync::watch;

use super::{Error, Service, error_map::catalog_error};
use crate::registry::Listed;

/// Follows which indices are served.
pub struct CatalogWatch {
    service: Service,
    changes: watch::Receiver<()>,
}

impl Service {
    /// Begins to follow which indices are served; fails while there is no registry.
    pub fn watch_catalog(&self) -> Result<CatalogWatch, Error> {
        let mut changes = self.registry()?.changes();
        // What there is already is told first.
        changes.mark_changed();
        Ok(CatalogWatch {
            service: self.clone(),
            changes,
        })
    }
}

impl CatalogWatch {
    /// The uids of the indices that can be read, by name, whenever there may be others than before; at first at once.
    pub async fn changed(&mut self) -> Result<BTreeMap<String, String>, Error> {
        // The sender is in the registry, which the service holds.
        let _ = self.changes.changed().await;
        match self.service.registry()?.page(None, usize::MAX) {
            Ok(listed) => Ok(listed.into_iter().filter_map(hosted).collect()),
            Err(error) => Err(catalog_error(error)),
        }
    }
}

fn hosted(listed: Listed) -> Option<(String, String)> {
    match listed {
        Listed::Hosted(hosted) => Some((hosted.name().into(), hosted.uid_text().into())),
        Listed::Damaged { .. } => None,
    }
}
