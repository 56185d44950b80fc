//! The sources of settings, the layer that wins, and the messages for wrong settings.

use std::{collections::BTreeMap, fs, path::PathBuf};

use tempfile::TempDir;
use wayfold_server::{
    config::{Config, ConfigError},
    log::Durability,
};

struct File {
    _directory: TempDir,
    path: PathBuf,
}

fn file(text: &str) -> File {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("wayfold.toml");
    fs::write(&path, text).unwrap();
    File {
        _directory: directory,
        path,
    }
}

fn environment(variables: &[(&str, &str)]) -> BTreeMap<String, String> {
    let owned = |(name, value): &(&str, &str)| ((*name).to_owned(), (*value).to_owned());
    variables.iter().map(owned).collect()
}

fn load_file(text: &str) -> Result<Config, ConfigError> {
    Config::load(Some(&file(text).path), &BTreeMap::new(), &[])
}

fn load_variable(name: &str, value: &str) -> Result<Config, ConfigError> {
    Config::load(None, &environment(&[(name, value)]), &[])
}

#[test]
fn the_defaults_protect() {
    let config = Config::default();
    assert_eq!(config.grpc.listen, "127.0.0.1:50051");
    assert_eq!(config.grpc.max_message_bytes, 16 << 20);
    assert_eq!(config.zenoh.listen, "tcp/127.0.0.1:7448");
    assert_eq!(config.data.dir, "./wayfold-data");
    assert_eq!(config.data.durability, Durability::Fsync);
    // Stock gRPC clients accept messages of up to 4 MiB.
    assert!(config.limits.max_answer_bytes < 4 << 20);
    assert_eq!(config.limits, wayfold_server::service::Limits::default());
}

#[test]
fn the_limits_of_sessions_are_settings() {
    let names = [
        "max_sessions",
        "max_session_idle_seconds",
        "max_reserved_ids",
        "max_held_scans",
    ];
    let text = names.map(|name| format!("{name} = 9\n")).concat();
    let limits = load_file(&format!("[limits]\n{text}")).unwrap().limits;
    let found = (
        limits.max_sessions,
        limits.max_session_idle_seconds,
        limits.max_reserved_ids,
        limits.max_held_scans,
    );
    assert_eq!(found, (9, 9, 9, 9));
}

#[test]
fn each_layer_wins_over_the_one_before() {
    let file = file(
        "[grpc]\nlisten = 'file'\nmax_connections = 7\nstream_window = 7\n[log]\nfilter = 'warn'\n",
    );
    let environment = environment(&[
        ("WAYFOLD_GRPC__LISTEN", "environment"),
        ("WAYFOLD_GRPC__MAX_CONNECTIONS", "8"),
        ("HOME", "/home/somebody"),
    ]);
    let flags = [("grpc.listen", "flag".to_owned())];
    let config = Config::load(Some(&file.path), &environment, &flags).unwrap();
    assert_eq!(config.grpc.listen, "flag");
    assert_eq!(config.grpc.max_connections, 8);
    assert_eq!(config.grpc.stream_window, 7);
    assert_eq!(config.log.filter, "warn");
    let mut expected = Config::default();
    expected.grpc.listen = "flag".into();
    expected.grpc.max_connections = 8;
    expected.grpc.stream_window = 7;
    expected.log.filter = "warn".into();
    assert_eq!(config, expected);
}

#[test]
fn an_empty_file_and_empty_sections_change_nothing() {
    for text in ["", "# nothing\n", "[grpc]\n[limits]\n"] {
        assert_eq!(load_file(text).unwrap(), Config::default());
    }
}

#[test]
fn an_unknown_key_is_named_with_its_place_and_the_nearest_one() {
    for (text, key, nearest) in [
        ("[grpc]\nlisten_on = 'x'", "grpc.listen_on", "grpc.listen"),
        ("[limits]\nmax_ks = 3", "limits.max_ks", "limits.max_k"),
        (
            "max_connections = 3",
            "max_connections",
            "grpc.max_connections",
        ),
        (
            "[gprc]\nmax_connections = 3",
            "gprc.max_connections",
            "grpc.max_connections",
        ),
        ("[shutdwon]", "shutdwon", "shutdown.grace_ms"),
    ] {
        let file = file(text);
        let error = Config::load(Some(&file.path), &BTreeMap::new(), &[]).unwrap_err();
        let message = error.to_string();
        assert!(message.contains(&*file.path.to_string_lossy()), "{message}");
        assert!(message.contains(&format!("`{key}`")), "{message}");
        if !text.contains("shutdwon") {
            assert!(message.contains(&format!("`{nearest}`")), "{message}");
        }
    }
}

#[test]
fn an_unknown_variable_is_named_with_the_nearest_one() {
    for (name, nearest) in [
        ("WAYFOLD_GRPC__LISTNE", "WAYFOLD_GRPC__LISTEN"),
        ("WAYFOLD_GRPC_LISTEN", "WAYFOLD_GRPC__LISTEN"),
        (
            "WAYFOLD_LIMIT__MAX_ROWS_PER_CALL",
            "WAYFOLD_LIMITS__MAX_ROWS_PER_CALL",
        ),
    ] {
        let message = load_variable(name, "1").unwrap_err().to_string();
        assert!(message.contains(&format!("`{name}`")), "{message}");
        assert!(message.contains(&format!("`{nearest}`")), "{message}");
    }
    // The client's own.
    load_variable("WAYFOLD_SERVER", "http://127.0.0.1:1").unwrap();
}

#[test]
fn a_wrong_type_is_named() {
    for (text, key) in [
        ("[grpc]\nmax_connections = 'many'", "grpc.max_connections"),
        ("[grpc]\nmax_connections = true", "grpc.max_connections"),
        ("[grpc]\nmax_connections = 1.5", "grpc.max_connections"),
        ("[grpc]\nmax_connections = [1]", "grpc.max_connections"),
        ("[grpc]\nlisten = 50051", "grpc.listen"),
        ("grpc = 3", "grpc"),
    ] {
        let message = load_file(text).unwrap_err().to_string();
        assert!(message.contains(&format!("`{key}`")), "{message}");
        assert!(message.contains("wayfold.toml"), "{message}");
    }
    let error = load_variable("WAYFOLD_GRPC__MAX_CONNECTIONS", "many").unwrap_err();
    let message = error.to_string();
    assert!(
        message.contains("WAYFOLD_GRPC__MAX_CONNECTIONS"),
        "{message}"
    );
    assert!(message.contains("an integer, not \"many\""), "{message}");
}

#[test]
fn a_value_out_of_range_is_named() {
    for (text, key) in [
        ("[grpc]\nmax_connections = 0", "grpc.max_connections"),
        ("[grpc]\nmax_connections = -1", "grpc.max_connections"),
        ("[shutdown]\ngrace_ms = -1", "shutdown.grace_ms"),
        (
            "[grpc]\nmax_calls_per_connection = 1",
            "grpc.max_calls_per_connection",
        ),
        (
            "[grpc]\nmax_calls_per_connection = 5_000_000_000",
            "grpc.max_calls_per_connection",
        ),
        ("[log]\nformat = 'xml'", "log.format"),
        ("[data]\ndir = ''", "data.dir"),
    ] {
        let message = load_file(text).unwrap_err().to_string();
        assert!(message.contains(&format!("`{key}`")), "{message}");
        assert!(message.contains("wayfold.toml"), "{message}");
    }
    load_file("[shutdown]\ngrace_ms = 0\n[runtime]\nworkers = 0").unwrap();
}

#[test]
fn a_growing_tree_has_no_more_rows_than_the_index_library_takes() {
    let load = |rows: usize| load_file(&format!("[index]\ngrowing_rows = {rows}"));
    assert_eq!(load(1 << 20).unwrap().index.growing_rows, 1 << 20);
    let text = load((1 << 20) + 1).unwrap_err().to_string();
    assert!(
        text.contains("`index.growing_rows`: 1048577 is too large; at most 1048576"),
        "{text}"
    );
}

#[test]
fn numbers_with_which_the_server_could_not_work_are_refused() {
    for text in [
        "[limits]\nmax_answer_bytes = 262_143",
        "[index]\nmerge_threads = 1025",
        "[grpc]\nmax_message_bytes = 4_294_967_296",
        "[zenoh]\nmax_message_bytes = 4_294_967_296",
        "[snapshot]\nevery_seconds = 3_153_600_001",
    ] {
        let message = load_file(text).unwrap_err().to_string();
        assert!(message.contains("is too"), "{message}");
    }
    load_file("[limits]\nmax_answer_bytes = 262_144\n[index]\nmerge_threads = 1024").unwrap();
}

#[test]
fn a_percentage_is_at_most_100() {
    assert!(load_file("[memory]\nhigh_percent = 100").is_ok());
    let error = load_file("[memory]\nhigh_percent = 101").unwrap_err();
    let text = error.to_string();
    assert!(text.contains("memory.high_percent"), "{text}");
    assert!(text.contains("at most 100"), "{text}");
}

#[test]
fn a_file_that_cannot_be_read_is_named() {
    let message = load_file("[grpc").unwrap_err().to_string();
    assert!(message.contains("wayfold.toml"), "{message}");
    let missing = PathBuf::from("no/such/wayfold.toml");
    let error = Config::load(Some(&missing), &BTreeMap::new(), &[]).unwrap_err();
    assert!(
        error.to_string().contains("no/such/wayfold.toml"),
        "{error}"
    );
}

#[test]
fn a_secret_in_a_wrong_line_is_not_shown() {
    for (text, problem) in [
        (
            "[cluster]\nnats = \"nats://me:\"s3cret\"@one\"",
            "line 2, column 20: ",
        ),
        (
            "[cluster]\nname = 'a'\npassword s3cret",
            "line 3, column 10: ",
        ),
        ("nats = 's3cret", "line 1, column 15: "),
        (
            "[cluster]\nnats = ['nats://me:s3cret@one']",
            "`cluster.nats` takes a string, not an array",
        ),
        (
            "[cluster]\nnats = { password = 's3cret' }",
            "`cluster.nats.password`",
        ),
        (
            "[cluster]\ncredentials = [['s3cret']]",
            "a string, not an array",
        ),
        (
            "[zenoh]\nconfig = [{ password = 's3cret' }]",
            "a string, not an array",
        ),
        ("[zenoh]\nconfig = 5318008", "a string, not a number"),
    ] {
        let message = load_file(text).unwrap_err().to_string();
        assert!(message.contains("wayfold.toml"), "{message}");
        assert!(message.contains(problem), "{message}");
        assert!(!message.contains("s3cret"), "{message}");
        assert!(!message.contains("5318008"), "{message}");
    }
}

#[test]
fn a_secret_in_the_environment_or_a_flag_is_not_shown() {
    const SECRET: &str = "nats://me:s3cret@one";
    for name in ["WAYFOLD_CLUSTER__NAST", "WAYFOLD_CLUSTER_NATS"] {
        let message = load_variable(name, SECRET).unwrap_err().to_string();
        assert!(!message.contains("s3cret"), "{message}");
    }
    let flags = [("cluster.nast", SECRET.to_owned())];
    let error = Config::load(None, &BTreeMap::new(), &flags).unwrap_err();
    assert!(!error.to_string().contains("s3cret"), "{error}");
}

#[test]
fn a_name_of_a_cluster_that_nats_does_not_take_is_refused() {
    for name in ["a.b", "a b", "a/b", ">", "ü"] {
        let error = load_file(&format!("[cluster]\nname = '{name}'")).unwrap_err();
        let text = error.to_string();
        assert!(text.contains("cluster.name"), "{text}");
        assert!(
            text.contains(&format!("\"{name}\" has more than")),
            "{text}"
        );
    }
    load_file("[cluster]\nname = 'cell-3_B'").unwrap();
}
