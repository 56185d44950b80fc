//! Limits on the number of indices.

use std::sync::Arc;

use super::RegistryError;

/// There may be at most this many indices whose names count.
#[derive(Clone)]
pub struct IndexLimit {
    /// The name of the limit, for its error.
    pub setting: &'static str,
    /// The most indices.
    pub max: usize,
    /// True for the name of an index that counts.
    pub counts: Arc<dyn Fn(&str) -> bool + Send + Sync>,
}

impl IndexLimit {
    /// Fails if these indices leave no room for another one.
    pub(super) fn check<'a>(
        &self,
        names: impl Iterator<Item = &'a String>,
    ) -> Result<(), RegistryError> {
        if names.filter(|name| (self.counts)(name)).count() < self.max {
            return Ok(());
        }
        Err(RegistryError::TooManyIndexes {
            setting: self.setting,
            max: self.max,
        })
    }
}
