//! Other servers under the face's prefix.

use tracing::warn;
use zenoh::{Session, liveliness::LivelinessToken, pubsub::Subscriber, sample::SampleKind};

use super::ZenohError;
use crate::observe::SparseLines;

/// The bytes of an id of Zenoh as text. A stranger may declare a longer one.
const MAX_ID_BYTES: usize = 32;

/// Announces this server to others under the same prefix, and watches for them. If two servers share routers and a
/// prefix, but no indices, either one takes a query. Servers without a cluster warn of all others in their logs.
pub(super) struct ServerWatch {
    _token: LivelinessToken,
    _others: Option<Subscriber<()>>,
}

impl ServerWatch {
    /// Is announced until dropped, and `warns` of every other server.
    pub(super) async fn watch(
        session: &Session,
        prefix: &str,
        warns: bool,
    ) -> Result<Self, ZenohError> {
        let own = session.zid().to_string();
        let token = session
            .liveliness()
            .declare_token(format!("{prefix}/@server/{own}"))
            .await
            .map_err(ZenohError::declare)?;
        if !warns {
            return Ok(Self {
                _token: token,
                _others: None,
            });
        }
        let under = prefix.to_owned();
        // A stranger may declare any number of them.
        let lines = SparseLines::new();
        let others = session
            .liveliness()
            .declare_subscriber(format!("{prefix}/@server/*"))
            .history(true)
            .callback(move |sample| {
                let key = sample.key_expr().as_str();
                let other = key.rsplit('/').next().unwrap_or_default();
                if sample.kind() == SampleKind::Put
                    && other != own
                    && let Some(left_out) = lines.next()
                {
                    let other = &other[..other.floor_char_boundary(MAX_ID_BYTES)];
                    warn!(
                        prefix = under,
                        other,
                        left_out,
                        "another server answers under this prefix, and a query may reach either: set a \
                         zenoh.prefix for each server that shares routers with another, or a cluster for both"
                    );
                }
            })
            .await
            .map_err(ZenohError::declare)?;
        Ok(Self {
            _token: token,
            _others: Some(others),
        })
    }
}
