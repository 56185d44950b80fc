use super::*;

fn with(config: &str) -> Result<Config, ZenohError> {
    settings(&ZenohConfig {
        config: config.into(),
        ..crate::config::Config::default().zenoh
    })
}

fn at(config: &Config, key: &str) -> Value {
    serde_json::from_str(&config.get_json(key).unwrap()).unwrap()
}

#[test]
fn nothing_is_scouted_for_and_loopback_is_listened_on() {
    let config = with("{}").unwrap();
    assert_eq!(at(&config, "scouting/multicast/enabled"), json!(false));
    assert_eq!(at(&config, "scouting/gossip/enabled"), json!(false));
    assert_eq!(
        at(&config, "listen/endpoints"),
        json!(["tcp/127.0.0.1:7448"])
    );
}

#[test]
fn strangers_take_few_places_for_a_short_time() {
    let unicast = |config: &str, key: &str| {
        let config = with(config).unwrap();
        at(&config, &format!("transport/unicast/{key}"))
    };
    for (key, expected) in [
        ("accept_timeout", 2_000),
        ("accept_pending", 1_000),
        ("max_sessions", 1_000),
    ] {
        assert_eq!(unicast("{}", key), json!(expected), "{key}");
    }
    let more = "{ transport: { unicast: { max_sessions: 5000 } } }";
    assert_eq!(unicast(more, "max_sessions"), json!(5_000));
    assert_eq!(unicast(more, "accept_timeout"), json!(2_000));
}

#[test]
fn settings_of_zenoh_can_be_set() {
    let config = with(
        "{ mode: 'client', /* a robot's */ connect: { endpoints: ['tcp/127.0.0.1:7447'] },
           scouting: { gossip: { enabled: true } } }",
    )
    .unwrap();
    assert_eq!(at(&config, "mode"), json!("client"));
    assert_eq!(
        at(&config, "connect/endpoints"),
        json!(["tcp/127.0.0.1:7447"])
    );
    assert_eq!(at(&config, "scouting/gossip/enabled"), json!(true));
    assert_eq!(at(&config, "scouting/multicast/enabled"), json!(false));
}

#[test]
fn rules_of_the_user_replace_those_of_the_server() {
    let rules = |config: &str| at(&with(config).unwrap(), "access_control");
    let own = rules("{}");
    assert_eq!(own["enabled"], json!(true));
    assert_eq!(own["rules"][0]["key_exprs"], json!(["**", "**/@alive/**"]));
    let off = rules("{ access_control: { enabled: false } }");
    assert_eq!(
        (&off["enabled"], &off["rules"]),
        (&json!(false), &json!(null))
    );
}

#[test]
fn every_way_beyond_this_machine_is_named() {
    let exposed = |listen: &str, config: &str| {
        let config = ZenohConfig {
            listen: listen.into(),
            config: config.into(),
            ..crate::config::Config::default().zenoh
        };
        let exposed = exposed(&config).unwrap().into_iter();
        exposed.map(|it| it.has_tls).collect::<Vec<_>>()
    };
    for local in ["tcp/127.0.0.1:0", "tcp/localhost:0", "tcp/[::1]:0", "off"] {
        assert!(exposed(local, "{}").is_empty(), "{local}");
    }
    assert_eq!(exposed("tls/0.0.0.0:1", "{}"), [true]);
    let router = "{ connect: { endpoints: { peer: ['tcp/10.0.0.7:7447'] } } }";
    assert_eq!(exposed("tcp/[::]:0", router), [false, false]);
    let scouting = "{ scouting: { multicast: { enabled: true } } }";
    assert_eq!(exposed("tcp/127.0.0.1:0", scouting), [false]);
    // It stands for Zenoh's default, which is on.
    let default = "{ scouting: { gossip: { enabled: null } } }";
    assert_eq!(exposed("tcp/127.0.0.1:0", default), [false]);
}

#[test]
fn a_wrong_address_is_refused_with_an_example() {
    let checked = |listen: &str| {
        let zenoh = crate::config::Config::default().zenoh;
        let listen = listen.into();
        exposed(&ZenohConfig { listen, ..zenoh })
    };
    for listen in [
        "garbage",
        "OFF",
        "tcp/",
        "127.0.0.1:7448",
        "udp/127.0.0.1:1",
    ] {
        let error = checked(listen).unwrap_err().to_string();
        assert!(error.contains("tcp/127.0.0.1:7448"), "{listen}: {error}");
    }
    for listen in ["tcp/127.0.0.1:7448", "tls/robot.local:1#iface=eth0"] {
        checked(listen).unwrap();
    }
}

#[test]
fn an_address_is_in_use_while_another_listens_there() {
    let other = TcpListener::bind("127.0.0.1:0").unwrap();
    let listen = format!("tcp/{}", other.local_addr().unwrap());
    assert!(is_in_use(&listen));
    assert!(!is_in_use("tcp/127.0.0.1:0"));
}

#[test]
fn errors_do_not_tell_where_in_a_source_they_arose() {
    let problem = "Unable to open: tcp/1:2 at /a/b.rs:12. - Caused by - no at /c d.rs:3.";
    let cleaned = without_places(problem);
    assert_eq!(cleaned, "Unable to open: tcp/1:2 - Caused by - no");
    assert_eq!(without_places("no at /x"), "no at /x");
}

#[test]
fn the_options_of_endpoints_are_not_shown() {
    for (text, shown) in [
        ("tls/a:1#key=AB+/=;b=c", "tls/a:1"),
        (
            r#"["tls/a:1#k=A/=", "tcp/b:2"]"#,
            r#"["tls/a:1", "tcp/b:2"]"#,
        ),
        (
            "no link to tls/a:1#k=A. Caused by - x",
            "no link to tls/a:1 Caused by - x",
        ),
        ("tcp/b:2", "tcp/b:2"),
    ] {
        assert_eq!(without_options(text), shown);
    }
}

#[test]
fn a_text_that_is_no_configuration_is_refused() {
    for config in [
        "",
        "[]",
        "{ mode",
        "{ mode: 'king' }",
        "{ no_such_setting: 1 }",
    ] {
        let error = with(config).unwrap_err().to_string();
        assert!(error.starts_with("zenoh.config: "), "{config}: {error}");
    }
    let auth = "{ transport: { auth: { usrpwd: {\n user: 'u', password: 's3cretPW' oops } } } }";
    let error = with(auth).unwrap_err().to_string();
    assert!(error.contains("line 2, column "), "{error}");
    assert!(!error.contains("s3cretPW"), "{error}");
    for wrong in [
        "{ transport: { auth: { usrpwd: 's3cretPW' } } }",
        "{ transport: { auth: { usrpwd: { user: 'u', password: ['s3cretPW'] } } } }",
        "{ mode: 's3cretPW' }",
        "{ connect: { endpoints: ['s3cretPW'] } }",
    ] {
        let error = with(wrong).unwrap_err().to_string();
        assert!(!error.contains("s3cretPW"), "{error}");
    }
}
