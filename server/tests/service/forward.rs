//! Macros for test logs that forward most calls to a log in memory.

/// A `Catalogue` that forwards to the field of a log.
macro_rules! forward_catalogue {
    ($log:ty, $field:tt) => {
        impl wayfold_server::log::Catalogue for $log {
            fn indexes(&self) -> Result<Vec<wayfold_server::log::Entry>, LogError> {
                self.$field.indexes()
            }

            fn create(&self, entry: wayfold_server::log::Entry) -> Result<(), LogError> {
                self.$field.create(entry)
            }

            fn delete(&self, uid: Uid) -> Result<(), LogError> {
                self.$field.delete(uid)
            }
        }
    };
}

/// Forwards all of `Journal` but `submit` and `follow`.
macro_rules! forward_journal {
    ($field:tt) => {
        fn read(
            &self,
            uid: Uid,
            after: Option<u64>,
            max_bytes: usize,
        ) -> Result<Vec<Arc<Record>>, LogError> {
            self.$field.read(uid, after, max_bytes)
        }

        fn newest(&self, uid: Uid) -> Result<u64, LogError> {
            self.$field.newest(uid)
        }
    };
}

/// A `Journal` that forwards to the field of a log.
macro_rules! forward_whole_journal {
    ($log:ty, $field:tt) => {
        impl wayfold_server::log::Journal for $log {
            $crate::forward::forward_journal!($field);

            fn submit(
                &self,
                uid: Uid,
                record: Arc<Record>,
            ) -> Result<wayfold_server::log::Receipt, LogError> {
                self.$field.submit(uid, record)
            }

            fn follow(&self, uid: Uid, after: u64) -> wayfold_server::log::RecordStream {
                self.$field.follow(uid, after)
            }
        }
    };
}

/// Forwards all of `PointStore` but `apply` and `view`.
macro_rules! forward_points {
    ($field:tt) => {
        fn trim(
            &self,
            uid: Uid,
            retention: &wayfold_server::log::Retention,
        ) -> Result<(), LogError> {
            self.$field.trim(uid, retention)
        }

        fn window(&self, uid: Uid) -> Result<wayfold_server::log::Window, LogError> {
            self.$field.window(uid)
        }

        fn operations(
            &self,
            uid: Uid,
        ) -> Result<Vec<Arc<wayfold_server::log::Operation>>, LogError> {
            self.$field.operations(uid)
        }

        fn restore(
            &self,
            entry: wayfold_server::log::Entry,
            origin: wayfold_server::log::Origin,
            replaces: bool,
        ) -> Result<Box<dyn wayfold_server::log::PointWriter>, LogError> {
            self.$field.restore(entry, origin, replaces)
        }
    };
}

pub(crate) use {forward_catalogue, forward_journal, forward_points, forward_whole_journal};
