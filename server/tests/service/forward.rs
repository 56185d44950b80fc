//! Logs in memory that do something otherwise.

/// Forwards all of `Log` but `append`, `synced` and `points` to the log in this field.
macro_rules! forward_to {
    ($field:tt) => {
        fn indexes(&self) -> Result<Vec<wayfold_server::log::Entry>, LogError> {
            self.$field.indexes()
        }

        fn create(&self, entry: wayfold_server::log::Entry) -> Result<(), LogError> {
            self.$field.create(entry)
        }

        fn restore(
            &self,
            entry: wayfold_server::log::Entry,
            origin: wayfold_server::log::Origin,
        ) -> Result<Box<dyn wayfold_server::log::Restoring>, LogError> {
            self.$field.restore(entry, origin)
        }

        fn delete(&self, uid: Uid) -> Result<(), LogError> {
            self.$field.delete(uid)
        }

        fn tail(
            &self,
            uid: Uid,
            after: Option<u64>,
            most: usize,
        ) -> Result<Vec<Arc<Record>>, LogError> {
            self.$field.tail(uid, after, most)
        }

        fn operations(
            &self,
            uid: Uid,
        ) -> Result<Vec<Arc<wayfold_server::log::Operation>>, LogError> {
            self.$field.operations(uid)
        }

        fn trim(&self, uid: Uid, keep: &wayfold_server::log::Keep) -> Result<(), LogError> {
            self.$field.trim(uid, keep)
        }
    };
}

pub(crate) use forward_to;
