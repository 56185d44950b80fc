//! Announces the indices: a liveliness token for each served index, and the mutations of each index that has a
//! subscriber, read from the log as `Watch` reads it.
//!
//! A full link drops publications: no subscriber delays the server or fills its memory. Each message has the uid, and
//! each mutation its revision and the number of its piece: a subscriber sees a gap and requests it from `log`.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use futures_util::future::{select_all, try_join_all};
use tokio::{sync::watch, time::timeout};
use tokio_util::{sync::CancellationToken, task::AbortOnDropHandle};
use tracing::{debug, warn};
use wayfold_proto::v1;
use zenoh::{
    Session, Wait, key_expr::KeyExpr, liveliness::LivelinessToken, matching::MatchingListener,
    pubsub::Publisher, qos::CongestionControl,
};

use super::encoding::encoding;
use crate::{
    service::{Call, CatalogWatch, Code, Error, Service, Unavailability},
    verbs::Form,
};

/// The pause before an index whose log could not be read is read again.
const READ_RETRY_PAUSE: Duration = Duration::from_secs(1);

/// Approximate bytes of a publication. Zenoh fragments one that is larger than its batch, and a lost fragment loses
/// all.
const MESSAGE_BYTES: usize = 48 * 1024;

/// A form of published mutations.
#[derive(Clone, Copy)]
struct FeedForm {
    form: Form,
    /// The last part of its key.
    last: &'static str,
    with_payloads: bool,
}

/// A shared index holds no payloads: it follows the last of these.
const FEEDS: [FeedForm; 3] = [
    FeedForm {
        form: Form::Protobuf,
        last: "events",
        with_payloads: true,
    },
    FeedForm {
        form: Form::Json,
        last: "events/json",
        with_payloads: true,
    },
    FeedForm {
        form: Form::Protobuf,
        last: "events/states",
        with_payloads: false,
    },
];

/// Announces the indices, until it is dropped.
pub(super) struct Announcer {
    pub(super) service: Service,
    pub(super) session: Session,
    pub(super) prefix: String,
    /// Set once the server stops.
    pub(super) stopping: CancellationToken,
    /// False if no mutations are published, because Zenoh delivers them to strangers too.
    pub(super) publishes: bool,
}

/// The announcements of one index.
struct Announcement {
    uid: String,
    _token: LivelinessToken,
    /// One for each form to which any index has a subscriber.
    feeds: [Option<AbortOnDropHandle<()>>; FEEDS.len()],
}

/// Watches whether any index has a subscriber to one form.
struct SubscriberWatch {
    /// True while there is one.
    followed: watch::Receiver<bool>,
    _listener: MatchingListener<()>,
    _publisher: Publisher<'static>,
}

impl Announcer {
    /// Announces the served indices. Ends only on a failure.
    pub(super) async fn run(self) {
        let failed = match self.service.watch_catalog() {
            Ok(catalog) => self.announce(catalog).await,
            Err(error) => Err(error.to_string()),
        };
        if let Err(error) = failed {
            warn!(error, "the indices are not announced over Zenoh any more");
        }
    }

    async fn announce(&self, mut catalog: CatalogWatch) -> Result<(), String> {
        let subscribers = FEEDS.map(|feed| self.watch_subscribers(feed.last));
        let mut subscribers = try_join_all(subscribers).await?;
        let mut indices = BTreeMap::new();
        let mut announced = BTreeMap::new();
        loop {
            let followed = subscribers.iter_mut();
            let followed = followed.map(|it| Box::pin(it.followed.changed()));
            tokio::select! {
                changed = catalog.changed() => match changed {
                    Ok(now) => indices = now,
                    // The indices are unknown until the store is open.
                    Err(error) => debug!(%error, "cannot list the indices"),
                },
                (changed, ..) = select_all(followed) => changed.map_err(|error| error.to_string())?,
            }
            let followed = subscribers.iter_mut();
            let followed: Vec<_> = followed
                .map(|it| *it.followed.borrow_and_update())
                .collect();
            self.bring_up_to_date(&mut announced, &indices, &followed)
                .await?;
        }
    }

    /// Follows the presence of subscribers.
    async fn watch_subscribers(&self, name: &str) -> Result<SubscriberWatch, String> {
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
        Ok(SubscriberWatch {
            followed,
            _listener: listener.map_err(|error| error.to_string())?,
            _publisher: publisher,
        })
    }

    async fn bring_up_to_date(
        &self,
        announced: &mut BTreeMap<String, Announcement>,
        indices: &BTreeMap<String, String>,
        followed: &[bool],
    ) -> Result<(), String> {
        announced.retain(|name, known| indices.get(name) == Some(&known.uid));
        for (name, uid) in indices {
            if !announced.contains_key(name) {
                let token = self.session.liveliness();
                let token = token.declare_token(self.key(name, "@alive")?).await;
                let known = Announcement {
                    uid: uid.clone(),
                    _token: token.map_err(|error| error.to_string())?,
                    feeds: Default::default(),
                };
                announced.insert(name.clone(), known);
            }
        }
        for (name, known) in announced {
            for (at, form) in FEEDS.into_iter().enumerate() {
                match (followed[at] && self.publishes, &known.feeds[at]) {
                    (true, None) => {
                        let feed = Feed {
                            service: self.service.clone(),
                            index: name.clone(),
                            uid: known.uid.clone(),
                            form,
                            stopping: self.stopping.clone(),
                        };
                        let key = self.key(name, form.last)?;
                        let publisher = self.publisher(key, form.form).await?;
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
            .encoding(encoding(form))
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
    form: FeedForm,
    stopping: CancellationToken,
}

impl Feed {
    /// Ends with the index, or with the server.
    async fn run(self, publisher: Publisher<'static>) {
        let publisher = Arc::new(publisher);
        // The newest revision that was read whole: later ones are published, at first those from now on.
        let mut after = None;
        while let Err(error) = self.publish(&publisher, &mut after).await {
            if error.code() == Code::NotFound {
                return;
            }
            debug!(index = self.index, %error, "the mutations cannot be read now");
            let stopping = timeout(READ_RETRY_PAUSE, self.stopping.cancelled());
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
            index_name: self.index.clone(),
            after_revision: after.clone(),
            include: Some(v1::Include {
                with_states: true,
                with_tags: true,
                with_revisions: true,
                with_payloads: self.form.with_payloads,
            }),
            own_session: 0,
        };
        let watch = self.service.watch(&Call::default(), request).await?;
        // One watch feeds all subscribers over Zenoh, so it counts as none of them.
        let mut watch = watch.uncounted().with_message_bytes(MESSAGE_BYTES);
        while let Some(message) = watch.next().await {
            let message = message?;
            let reset = message.reset.map(|_| message.reset());
            let newest = message.revision.clone().unwrap_or_default();
            if after.is_none() && newest.uid != self.uid {
                // The name belongs to another index now, with its own feed.
                return Ok(());
            }
            // In a cluster only the owner publishes. When that changes, a subscriber may miss a mutation or get one twice.
            if self.service.owns(&self.uid)
                && publisher
                    .matching_status()
                    .await
                    .is_ok_and(|it| it.matching())
            {
                let payload = self.form.form.write(&message)?;
                self.put(publisher, payload).await;
            }
            let whole = message.mutations.iter().rfind(|last| !last.continued);
            match (reset, whole) {
                (None, Some(last)) => *after = last.revision.clone(),
                (None, None) => *after = after.take().or(Some(newest)),
                // Also another index.
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
        // Zenoh blocks the thread for a moment before it drops a publication.
        let put = tokio::task::spawn_blocking(move || publisher.put(payload).wait());
        if let Ok(Err(error)) = put.await {
            debug!(index = self.index, %error, "mutations could not be published");
        }
    }
}
