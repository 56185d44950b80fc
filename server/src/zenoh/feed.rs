//! What is announced of the indices: a liveliness token for each that is served, and the mutations of those that somebody
//! follows, read from the log as `Watch` reads it.
//!
//! Publications are dropped where a subscriber's link is full, so that none of them holds up the server or fills its
//! memory. Each message says the uid, and each mutation its revision and, where it is told in pieces, which piece it is: a
//! subscriber sees a gap, and asks `log` for it.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use tokio::{sync::watch, time::timeout};
use tokio_util::{sync::CancellationToken, task::AbortOnDropHandle};
use tracing::{debug, warn};
use wayfold_proto::v1;
use zenoh::{
    Session, Wait, key_expr::KeyExpr, liveliness::LivelinessToken, matching::MatchingListener,
    pubsub::Publisher, qos::CongestionControl,
};

use super::{codec::Form, message::Named};
use crate::service::{Call, CatalogWatch, Code, Error, Service, Unavailability};

/// How long to leave an index alone of which the log could not be read.
const PAUSE_AFTER_FAILURE: Duration = Duration::from_secs(1);

/// About how many bytes a publication has: one that is larger than a batch of Zenoh's is cut up, and is lost with any
/// of its parts.
const MESSAGE_BYTES: usize = 48 * 1024;

/// The forms in which mutations are published, and the last part of the key for each.
const FEEDS: [(Form, &str); 2] = [(Form::Protobuf, "events"), (Form::Json, "events/json")];

/// Announces the indices, until it is dropped.
pub(super) struct Announcer {
    pub(super) service: Service,
    pub(super) session: Session,
    pub(super) prefix: String,
    /// Set once the server stops.
    pub(super) stopping: CancellationToken,
}

/// What is announced of one index.
struct Announced {
    uid: String,
    _token: LivelinessToken,
    /// One for each form that somebody follows.
    feeds: [Option<AbortOnDropHandle<()>>; FEEDS.len()],
}

/// Whether anybody follows any index, in one form.
struct Interest {
    followed: watch::Receiver<bool>,
    _listener: MatchingListener<()>,
    _publisher: Publisher<'static>,
}

impl Announcer {
    /// Announces what is served. Ends only if it fails.
    pub(super) async fn run(self) {
        let failed = match self.service.watch_catalog() {
            Ok(served) => self.announce(served).await,
            Err(error) => Err(error.to_string()),
        };
        if let Err(error) = failed {
            warn!(error, "the indices are not announced over Zenoh any more");
        }
    }

    async fn announce(&self, mut served: CatalogWatch) -> Result<(), String> {
        let [protobuf, json] = FEEDS.map(|(_, name)| self.interest(name));
        let (mut protobuf, mut json) = (protobuf.await?, json.await?);
        let mut indices = BTreeMap::new();
        let mut announced = BTreeMap::new();
        loop {
            tokio::select! {
                changed = served.changed() => match changed {
                    Ok(now) => indices = now,
                    // Nothing is known of the indices while the store is not open.
                    Err(error) => debug!(%error, "cannot list the indices"),
                },
                changed = protobuf.followed.changed() => changed.map_err(|error| error.to_string())?,
                changed = json.followed.changed() => changed.map_err(|error| error.to_string())?,
            }
            let followed = [&mut protobuf, &mut json].map(|it| *it.followed.borrow_and_update());
            self.bring_up_to_date(&mut announced, &indices, followed)
                .await?;
        }
    }

    /// Follows whether anybody follows any index.
    async fn interest(&self, name: &str) -> Result<Interest, String> {
        let key = self.key("*", name)?;
        let publisher = self.session.declare_publisher(key).await;
        let publisher = publisher.map_err(|error| error.to_string())?;
        let (tell, followed) = watch::channel(false);
        let listener = publisher
            .matching_listener()
            .callback(move |status| {
                tell.send_replace(status.matching());
            })
            .await;
        Ok(Interest {
            followed,
            _listener: listener.map_err(|error| error.to_string())?,
            _publisher: publisher,
        })
    }

    async fn bring_up_to_date(
        &self,
        announced: &mut BTreeMap<String, Announced>,
        indices: &BTreeMap<String, String>,
        followed: [bool; FEEDS.len()],
    ) -> Result<(), String> {
        announced.retain(|name, known| indices.get(name) == Some(&known.uid));
        for (name, uid) in indices {
            if !announced.contains_key(name) {
                let token = self.session.liveliness();
                let token = token.declare_token(self.key(name, "@alive")?).await;
                let known = Announced {
                    uid: uid.clone(),
                    _token: token.map_err(|error| error.to_string())?,
                    feeds: [None, None],
                };
                announced.insert(name.clone(), known);
            }
        }
        for (name, known) in announced {
            for (at, (form, last)) in FEEDS.into_iter().enumerate() {
                match (followed[at], &known.feeds[at]) {
                    (true, None) => {
                        let feed = Feed {
                            service: self.service.clone(),
                            index: name.clone(),
                            uid: known.uid.clone(),
                            form,
                            stopping: self.stopping.clone(),
                        };
                        let publisher = self.publisher(self.key(name, last)?, form).await?;
                        let running = tokio::spawn(feed.run(publisher));
                        known.feeds[at] = Some(AbortOnDropHandle::new(running));
                    }
                    (false, Some(_)) => known.feeds[at] = None,
                    _ => {}
                }
            }
        }
        Ok(())
    }

    async fn publisher(
        &self,
        key: KeyExpr<'static>,
        form: Form,
    ) -> Result<Publisher<'static>, String> {
        let publisher = self
            .session
            .declare_publisher(key)
            .encoding(form.encoding())
            .congestion_control(CongestionControl::Drop);
        publisher.await.map_err(|error| error.to_string())
    }

    fn key(&self, index: &str, last: &str) -> Result<KeyExpr<'static>, String> {
        let key = KeyExpr::try_from(format!("{}/{index}/{last}", self.prefix));
        key.map_err(|error| error.to_string())
    }
}

/// Publishes the mutations of one index.
struct Feed {
    service: Service,
    index: String,
    uid: String,
    form: Form,
    stopping: CancellationToken,
}

impl Feed {
    /// Ends with the index, or with the server.
    async fn run(self, publisher: Publisher<'static>) {
        let publisher = Arc::new(publisher);
        // The newest revision that was read whole; what comes after is published, at first what is new from now on.
        let mut after = None;
        while let Err(error) = self.publish(&publisher, &mut after).await {
            if error.code() == Code::NotFound {
                return;
            }
            debug!(index = self.index, %error, "the mutations cannot be read now");
            let stopping = timeout(PAUSE_AFTER_FAILURE, self.stopping.cancelled());
            if stopping.await.is_ok() {
                return;
            }
        }
    }

    /// Publishes until there is a failure.
    async fn publish(
        &self,
        publisher: &Arc<Publisher<'static>>,
        after: &mut Option<v1::Revision>,
    ) -> Result<(), Error> {
        let request = v1::WatchRequest {
            index: self.index.clone(),
            after_revision: after.clone(),
            include: Some(v1::Include {
                states: true,
                tags: true,
                revisions: true,
                payloads: true,
            }),
        };
        let watch = self.service.watch(&Call::default(), request).await?;
        let mut watch = watch.with_message_bytes(MESSAGE_BYTES);
        while let Some(message) = watch.next().await {
            let message = message?;
            let reset = message.reset.map(|_| message.reset());
            let newest = message.revision.clone().unwrap_or_default();
            if after.is_none() && newest.uid != self.uid {
                // Another index stands under the name, which has a feed of its own.
                return Ok(());
            }
            if publisher
                .matching_status()
                .await
                .is_ok_and(|it| it.matching())
            {
                let payload = self.form.write(v1::WatchResponse::NAME, &message)?;
                self.put(publisher, payload).await;
            }
            let whole = message.mutations.iter().rfind(|last| !last.continued);
            match (reset, whole) {
                (None, Some(last)) => *after = last.revision.clone(),
                (None, None) => *after = after.take().or(Some(newest)),
                // The same.
                (Some(v1::ResetReason::UidChanged), _) => return Ok(()),
                (Some(v1::ResetReason::WindowPassed | v1::ResetReason::Unspecified), _) => {
                    *after = Some(newest);
                }
            }
        }
        // A watch ends by itself only after a reset.
        Err(Error::Unavailable {
            why: Unavailability::Starting,
        })
    }

    async fn put(&self, publisher: &Arc<Publisher<'static>>, payload: Vec<u8>) {
        let publisher = Arc::clone(publisher);
        // Before it drops a publication, Zenoh waits a moment for room, and keeps the thread meanwhile.
        let put = tokio::task::spawn_blocking(move || publisher.put(payload).wait());
        if let Ok(Err(error)) = put.await {
            debug!(index = self.index, %error, "mutations could not be published");
        }
    }
}
