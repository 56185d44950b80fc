//! The stored points that a mutation changes. It reads them with their payloads before it holds the writer, and their bytes
//! count in the budgets of its call.

use std::sync::Arc;

use super::{Call, Error, stored::ReadAhead};
use crate::{
    admission::AnswerBytes,
    log::StoredPoint,
    registry::{Hosted, Published, Writer},
};

/// The most bytes of the points that one call changes, less if its connection may hold less: a request of a few bytes an id may
/// name points with 64 KiB each.
const MAX_CHANGED_BYTES: usize = 64 * 1024 * 1024;

const DOING: &str = "while reading the points; nothing was changed";

/// The points read so far.
pub(super) struct ChangedPoints {
    points: ReadAhead<Arc<StoredPoint>>,
    /// The bytes of the points.
    bytes: usize,
    held: AnswerBytes,
}

impl ChangedPoints {
    /// No points yet.
    pub(super) fn new(call: &Call) -> Self {
        Self {
            points: ReadAhead::new(false, Arc::clone),
            bytes: 0,
            held: call.answer_bytes(),
        }
    }

    /// A point; None if it is not stored or not read yet.
    pub(super) fn get(&self, id: u64) -> Option<&Arc<StoredPoint>> {
        self.points.get(id)
    }

    /// Reads the points of `published` with these ids, instead of those that were read before.
    pub(super) async fn read(
        &mut self,
        call: &Call,
        hosted: &Hosted,
        published: &Published,
        ids: &[u64],
    ) -> Result<(), Error> {
        self.forget();
        self.points.begin_at(published);
        let mut rest = ids;
        while !rest.is_empty() {
            let read = self.points.read_part(call, DOING, hosted, published, rest);
            let (part, others) = rest.split_at(read.await?);
            let points = part.iter().filter_map(|id| self.points.get(*id));
            let bytes = points.map(|point| held_bytes(point.bytes())).sum::<usize>();
            self.hold(bytes)?;
            rest = others;
        }
        Ok(())
    }

    /// Catches up to the writer's newest record. If the cached records do not reach back far enough, it forgets all points and
    /// returns false.
    pub(super) fn catch_up(&mut self, hosted: &Hosted, writer: &Writer) -> Result<bool, Error> {
        match self.points.catch_up(hosted, writer) {
            Some(0) => Ok(true),
            // A record may have replaced points that were read, and removed others.
            Some(_) => {
                let points = self.points.values().flatten();
                let bytes: usize = points.map(|point| held_bytes(point.bytes())).sum();
                let more = bytes.saturating_sub(self.bytes);
                self.bytes = bytes - more;
                self.hold(more).map(|()| true)
            }
            None => {
                self.forget();
                Ok(false)
            }
        }
    }

    fn hold(&mut self, more: usize) -> Result<(), Error> {
        self.bytes = self.bytes.saturating_add(more);
        let most = max_changed_bytes(&self.held);
        if self.bytes > most {
            let requested = self.bytes as u64;
            self.forget();
            return Err(Error::LimitExceeded {
                limit: "max_changed_point_bytes",
                value: most as u64,
                requested,
                advice: "the points count with their payloads: split the ids over several calls",
            });
        }
        Ok(self.held.take(more)?)
    }

    fn forget(&mut self) {
        self.points.clear();
        self.held.clear();
        self.bytes = 0;
    }
}

/// The most bytes of the points that the call of this answer changes.
pub(super) fn max_changed_bytes(held: &AnswerBytes) -> usize {
    MAX_CHANGED_BYTES.min(held.most())
}

/// The bytes of a point with its place in the map, which has twice the room at most.
fn held_bytes(point: usize) -> usize {
    point + 2 * size_of::<(u64, Arc<StoredPoint>)>()
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

    use bytes::Bytes;
    use wayfold_proto::v1;

    use super::*;
    use crate::{
        log::{LogError, RecordPosition, Sessions, View},
        testing::{admission, arm, engine, log_with, server},
    };

    const MIB: usize = 1024 * 1024;

    #[tokio::test]
    async fn the_points_that_a_call_changes_count_in_its_bytes() {
        let entry = arm();
        let log = engine(&entry, 10);
        let service = server(&log, &log);
        let admission = admission(64 * MIB);
        let (other, flow) = (admission.open().hold(), admission.open());
        let call = Call {
            held: Some(Arc::new(flow.hold())),
            ..Call::default()
        };
        let open = v1::OpenSessionRequest {
            index_name: "arm".into(),
            ..Default::default()
        };
        let session = service.open_session(&call, open).await.unwrap();
        let update = v1::UpdateRequest {
            index_name: "arm".into(),
            ids: (0..10).collect(),
            tags: vec![7],
            ..Default::default()
        };
        let write = v1::WriteRequest {
            index_name: "arm".into(),
            uid: entry.uid.to_string(),
            session: session.session,
            batch: 1,
            kinds: vec![v1::StepKind::SetTag.into(); 10],
            ids: (0..10).collect(),
            tags: vec![8; 10],
            ..Default::default()
        };
        // Only flows that hold little may take the last eighth.
        other.force_take(58 * MIB);
        let refused = service.update(&call, update.clone()).await;
        assert!(
            matches!(refused, Err(Error::TooManyBytes { .. })),
            "{refused:?}"
        );
        let refused = service.write(&call, write.clone()).await;
        assert!(
            matches!(refused, Err(Error::TooManyBytes { .. })),
            "{refused:?}"
        );
        assert_eq!(flow.held(), 0);
        other.release(58 * MIB);
        let updated = service.update(&call, update).await.unwrap();
        assert_eq!(updated.updated_count, 10);
        service.write(&call, write).await.unwrap();
        assert_eq!(flow.held(), 0);
    }

    /// A view with a point under every id. All payloads share one buffer, so that they take no memory.
    struct Heavy {
        inner: Arc<dyn View>,
        payload: Bytes,
        read: AtomicUsize,
    }

    impl View for Heavy {
        fn next_id(&self) -> u64 {
            self.inner.next_id()
        }

        fn sessions(&self) -> &Sessions {
            self.inner.sessions()
        }

        fn position(&self) -> RecordPosition {
            self.inner.position()
        }

        fn get(&self, id: u64) -> Result<Option<Arc<StoredPoint>>, LogError> {
            self.read.fetch_add(1, Relaxed);
            Ok(Some(Arc::new(StoredPoint {
                id,
                revision: 1,
                modified: 1,
                tag: 0,
                state: Box::new([0.5]),
                payload: self.payload.clone(),
            })))
        }

        fn page(
            &self,
            after: Option<u64>,
            limit: usize,
        ) -> Result<Vec<Arc<StoredPoint>>, LogError> {
            self.inner.page(after, limit)
        }
    }

    #[tokio::test]
    async fn a_call_reads_no_more_than_it_may_change() {
        let log = log_with(&arm(), &[]);
        let service = server(&log, &log);
        let hosted = service.registry().unwrap().get("arm").unwrap();
        let empty = hosted.published();
        let ids: Vec<u64> = (0..100_000).collect();
        // A connection has a quarter of these bytes.
        let small = Arc::new(admission(64 * MIB).open().hold());
        for (payload_bytes, held, most) in [
            (64 * 1024, None, 1024),
            (64 * 1024, Some(&small), 256),
            (0, None, ids.len()),
        ] {
            let heavy = Arc::new(Heavy {
                inner: Arc::clone(&empty.view),
                payload: vec![0; payload_bytes].into(),
                read: AtomicUsize::new(0),
            });
            let published = Published {
                snapshot: empty.snapshot.clone(),
                view: Arc::clone(&heavy) as Arc<dyn View>,
                revision: empty.revision,
                is_shared: false,
            };
            let call = Call {
                held: held.cloned(),
                ..Call::default()
            };
            let mut points = ChangedPoints::new(&call);
            let read = points.read(&call, &hosted, &published, &ids).await;
            let is_refused = matches!(
                read,
                Err(Error::LimitExceeded {
                    limit: "max_changed_point_bytes",
                    ..
                })
            );
            assert_eq!(is_refused, payload_bytes > 0, "{read:?}");
            let read = heavy.read.load(Relaxed);
            assert!(read <= most, "{read}");
        }
    }
}
