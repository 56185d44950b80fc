//! The answers of the command line that need no server: help, version, the default settings, and mistakes.

use std::process::{Command, Output};
#[cfg(unix)]
use std::{ffi::OsStr, os::unix::ffi::OsStrExt};
#[cfg(target_os = "linux")]
use std::{
    fs::{self, File},
    io::{self, BufRead, BufReader, Read},
    process::Stdio,
};

use wayfold_server::config::DEFAULTS;

fn run(arguments: &[&str], environment: &[(&str, &str)]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_wayfold-server"))
        .args(arguments)
        .envs(environment.iter().copied())
        .output()
        .unwrap()
}

fn stdout(arguments: &[&str]) -> String {
    let output = run(arguments, &[]);
    assert!(output.status.success());
    assert!(output.stderr.is_empty());
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn help_is_a_page_that_answers() {
    let help = stdout(&["--help"]);
    for part in [
        "nearest-neighbour indices",
        "--config <FILE>",
        "--grpc <ADDR>",
        "[default: 127.0.0.1:50051]",
        "--zenoh <LOCATOR>",
        "[default: tcp/127.0.0.1:7448]",
        "--data <DIR>",
        "--log <FILTER>",
        "--log-format <FORMAT>",
        "--print-config",
        "WAYFOLD_LIMITS__MAX_K=500",
        "Examples:",
        "wayfold create arm --space 'R3*SO3:0.15'",
        "Exit status:",
        "Next:",
    ] {
        assert!(help.contains(part), "{part} is missing in\n{help}");
    }
    assert!(
        help.lines().all(|line| line.chars().count() <= 120),
        "{help}"
    );
}

#[test]
fn version_names_the_program() {
    let expected = format!("wayfold-server {}\n", env!("CARGO_PKG_VERSION"));
    assert_eq!(stdout(&["--version"]), expected);
}

#[test]
fn the_default_settings_are_printed_as_they_are_and_can_be_read_back() {
    let printed = stdout(&["--print-config"]);
    assert_eq!(printed, DEFAULTS);
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("wayfold.toml");
    std::fs::write(&file, printed).unwrap();
    let config = wayfold_server::config::Config::load(Some(&file), &Default::default(), &[]);
    assert_eq!(config.unwrap(), wayfold_server::config::Config::default());
}

/// A full disk is no success; a reader that has seen enough, such as `head`, is.
#[cfg(target_os = "linux")]
#[test]
fn output_that_cannot_be_written_is_a_failure() {
    let (reader, closed) = io::pipe().unwrap();
    drop(reader);
    let full = File::options().write(true).open("/dev/full").unwrap();
    for (output, status, part) in [
        (
            Stdio::from(full),
            1,
            "cannot write to standard output: No space",
        ),
        (Stdio::from(closed), 0, ""),
    ] {
        let mut server = Command::new(env!("CARGO_BIN_EXE_wayfold-server"));
        let ended = server.arg("--print-config").stdout(output).output();
        let ended = ended.unwrap();
        let stderr = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(status), "{stderr}");
        assert!(
            stderr.contains(part) && stderr.is_empty() == part.is_empty(),
            "{stderr}"
        );
    }
}

#[test]
fn mistakes_exit_with_2_and_say_where() {
    for (arguments, environment, part) in [
        (&["--prot", "1"][..], &[][..], "--prot"),
        (&["--log-format", "xml"], &[], "xml"),
        (&["--log", "info,=x=y"], &[], "log.filter"),
        (&["--config", "no/such/file.toml"], &[], "no/such/file.toml"),
        (
            &[],
            &[("WAYFOLD_CONFIG", "no/such/file.toml")],
            "no/such/file.toml",
        ),
        (
            &[],
            &[("WAYFOLD_GRPC__LISTNE", "x")],
            "WAYFOLD_GRPC__LISTEN",
        ),
    ] {
        let output = run(arguments, environment);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{stderr}");
        assert!(stderr.contains(part), "{stderr}");
        assert!(output.stdout.is_empty());
    }
}

/// A server that ignored the directory would keep its indices in another one.
#[cfg(unix)]
#[test]
fn a_setting_that_is_not_unicode_exits_with_2() {
    let directory = tempfile::tempdir().unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_wayfold-server"))
        .args(["repair", "--dry-run"])
        .current_dir(directory.path())
        .env("WAYFOLD_DATA__DIR", OsStr::from_bytes(b"/srv/caf\xe9"))
        .output()
        .unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("WAYFOLD_DATA__DIR"), "{stderr}");
}

/// The soft limit of open files of a server that was started with a limit of 256, set by this option of `ulimit`, and its log.
#[cfg(target_os = "linux")]
fn file_limit(option: &str) -> (String, String) {
    let script = format!("ulimit {option} 256 && exec \"$0\" \"$@\"");
    let mut server = Command::new("sh")
        .args(["-c", &script, env!("CARGO_BIN_EXE_wayfold-server")])
        .args(["--grpc", "127.0.0.1:0", "--data", "memory"])
        .args(["--zenoh", "off", "--http", "off", "--log", "warn"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // It says its address once it serves.
    let mut first = String::new();
    let stdout = server.stdout.take().unwrap();
    BufReader::new(stdout).read_line(&mut first).unwrap();
    let limits = fs::read_to_string(format!("/proc/{}/limits", server.id())).unwrap();
    server.kill().unwrap();
    server.wait().unwrap();
    let mut log = String::new();
    server.stderr.unwrap().read_to_string(&mut log).unwrap();
    let files = limits
        .lines()
        .find_map(|it| it.strip_prefix("Max open files"));
    let soft = files.and_then(|it| it.split_whitespace().next());
    (soft.unwrap().to_owned(), log)
}

#[cfg(target_os = "linux")]
#[test]
fn the_limit_of_open_files_is_raised_and_reported_if_it_is_too_low() {
    // The soft limit alone, and both.
    let (raised, _) = file_limit("-Sn");
    assert_ne!(raised, "256");
    let (fixed, log) = file_limit("-n");
    assert_eq!(fixed, "256");
    assert!(log.contains("limit of open files is too low"), "{log}");
    assert!(log.contains("grpc.max_connections"), "{log}");
}
