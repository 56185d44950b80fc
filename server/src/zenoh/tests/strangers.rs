//! A session without a token neither answers for the server nor reaches the other sessions, at the server's own port and
//! behind a router with the rules of docs/zenoh.md.

use serde_json::json;
use zenoh::{
    bytes::ZBytes,
    query::{ConsolidationMode, QueryTarget},
    sample::{Locality, SampleKind},
};

use super::*;

/// Keys that reach those of the index `arm`: by its name, and by wildcards within and before the prefix.
const KEYS: [&str; 4] = [
    "wayfold/v1/arm/events/states",
    "wayfold/v1/**",
    "*/*/arm/**",
    "**",
];

/// The id of the server's session, by which the router knows it.
const SERVER: &str = "abc1";

/// A face, a router before it, and two clients.
struct Setting {
    face: ZenohFace,
    router: Option<Session>,
    stranger: Session,
    other: Session,
}

impl Setting {
    async fn at_the_port() -> Self {
        let (service, _) = service_with_index();
        let (face, other, _) = face_and_robot(service, Identities::default()).await;
        let locator = &face.locators().await[0];
        Self {
            stranger: client(locator).await,
            router: None,
            other,
            face,
        }
    }

    async fn behind_a_router() -> Self {
        let rules = "relayed";
        let router = json!({
            "mode": "router",
            "listen": { "endpoints": ["tcp/127.0.0.1:0"] },
            "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": false } },
            "access_control": {
                "enabled": true,
                "default_permission": "allow",
                "rules": [{
                    "id": rules,
                    "permission": "deny",
                    "flows": ["ingress"],
                    "messages": ["declare_queryable", "reply", "put", "delete", "liveliness_token"],
                    "key_exprs": ["**", "**/@alive/**"],
                }],
                "subjects": [{ "id": "everyone" }, { "id": "server", "zids": [SERVER] }],
                "policies": [{ "rules": [rules], "subjects": ["everyone"] }],
            },
        });
        let router = Config::from_json5(&router.to_string()).unwrap();
        let router = zenoh::open(router).await.unwrap();
        let locator = router.info().locators().await[0].to_string();
        let behind =
            json!({ "mode": "client", "id": SERVER, "connect": { "endpoints": [locator] } });
        let mut settings = crate::config::Config::default();
        settings.zenoh.listen = "tcp/127.0.0.1:0".into();
        settings.zenoh.config = behind.to_string();
        let (service, _) = service_with_index();
        let shared = FaceContext::new(&settings, service, Identities::default());
        let face = ZenohFace::open(&settings.zenoh, shared, false).await;
        Self {
            face: face.unwrap().unwrap(),
            stranger: client(&locator).await,
            other: client(&locator).await,
            router: Some(router),
        }
    }

    async fn close(self) {
        for session in [self.stranger, self.other].into_iter().chain(self.router) {
            session.close().await.unwrap();
        }
        self.face.stop().await;
    }
}

/// Returns once everything that the session has sent before is taken: a link is read in order.
async fn taken(session: &Session) {
    loop {
        let query = session.get("wayfold/v1/server");
        // Its own queryables do not count.
        let replies = query.allowed_destination(Locality::Remote).await.unwrap();
        if let Ok(reply) = replies.recv_async().await {
            reply.into_result().unwrap();
            return;
        }
    }
}

async fn a_stranger_gets_no_query_of_another_session(setting: Setting) {
    let (tell, mut received) = tokio::sync::mpsc::unbounded_channel();
    let mut answering = Vec::new();
    for key in ["wayfold/v1/arm/info", "wayfold/v1/**", "*/*/arm/**", "**"] {
        let tell = tell.clone();
        let queryable = setting.stranger.declare_queryable(key).complete(true);
        let queryable = queryable.callback(move |query| {
            let attachment = query.attachment().map(ZBytes::to_bytes);
            let _ = tell.send(attachment.map(Vec::from));
            let _ = query.reply(query.key_expr().clone(), "forged").wait();
        });
        answering.push(queryable.await.unwrap());
    }
    taken(&setting.stranger).await;
    taken(&setting.other).await;
    for key in ["wayfold/v1/arm/info", "wayfold/v1/*/info", "**"] {
        for target in [QueryTarget::BestMatching, QueryTarget::All] {
            let query = setting.other.get(key).attachment("token=secret");
            let query = query.target(target).consolidation(ConsolidationMode::None);
            let replies = query.timeout(Duration::from_secs(60)).await.unwrap();
            let mut answers = Vec::new();
            while let Ok(reply) = replies.recv_async().await {
                let answer = reply.into_result().unwrap();
                answers.push(String::from_utf8_lossy(&answer.payload().to_bytes()).into_owned());
            }
            // `**` reaches the list too.
            let expected = if key == "**" { 2 } else { 1 };
            assert_eq!(answers.len(), expected, "{key}: {answers:?}");
            assert!(answers.iter().all(|it| it.contains("arm")), "{answers:?}");
        }
    }
    assert!(received.try_recv().is_err(), "a stranger has got a query");
    drop(answering);
    setting.close().await;
}

async fn a_stranger_publishes_nothing_to_another_session(mut setting: Setting) {
    setting.face.announce(true).await.unwrap();
    let events = setting.other.declare_subscriber(KEYS[0]).await.unwrap();
    let arrived = async |payload: &'static str| {
        loop {
            // The server may not know the subscriber yet.
            setting
                .face
                .open
                .session
                .put(KEYS[0], payload)
                .await
                .unwrap();
            let event = async || {
                let event = tokio::time::timeout(Duration::from_millis(100), events.recv_async());
                event.await.ok().map(Result::unwrap)
            };
            while let Some(event) = event().await {
                let arrived = event.payload().to_bytes();
                assert_eq!(event.kind(), SampleKind::Put);
                assert_ne!(*arrived, *b"forged");
                if *arrived == *payload.as_bytes() {
                    return;
                }
            }
        }
    };
    arrived("first").await;
    for key in KEYS {
        let forged = setting.stranger.put(key, "forged");
        let forged = forged.congestion_control(CongestionControl::Block);
        forged.await.unwrap();
        setting.stranger.delete(key).await.unwrap();
    }
    taken(&setting.stranger).await;
    arrived("last").await;
    drop(events);
    setting.close().await;
}

async fn a_stranger_announces_no_index(mut setting: Setting) {
    setting.face.announce(true).await.unwrap();
    let mut tokens = Vec::new();
    for key in [
        "wayfold/v1/leg/@alive",
        "wayfold/v1/*/@alive/**",
        "**/@alive",
    ] {
        let token = setting.stranger.liveliness().declare_token(key);
        tokens.push(token.await.unwrap());
    }
    taken(&setting.stranger).await;
    loop {
        let alive = setting.other.liveliness().get("wayfold/v1/*/@alive");
        let alive = alive.await.unwrap();
        let mut keys = Vec::new();
        while let Ok(reply) = alive.recv_async().await {
            keys.push(reply.into_result().unwrap().key_expr().to_string());
        }
        // The server announces its index at some time.
        if !keys.is_empty() {
            assert_eq!(keys, ["wayfold/v1/arm/@alive"]);
            break;
        }
    }
    drop(tokens);
    setting.close().await;
}

macro_rules! tests {
    ($($test:ident),* $(,)?) => {
        mod at_the_port {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $test() {
                super::$test(super::Setting::at_the_port().await).await;
            })*
        }

        mod behind_a_router {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $test() {
                super::$test(super::Setting::behind_a_router().await).await;
            })*
        }
    };
}

tests!(
    a_stranger_gets_no_query_of_another_session,
    a_stranger_publishes_nothing_to_another_session,
    a_stranger_announces_no_index,
);
