//! Options that variables of the environment set.

use crate::{process::command, server::Server};

#[test]
fn an_empty_variable_counts_as_unset() {
    let server = Server::start();
    let mut list = command(&server.uri, &["list"]);
    for name in [
        "WAYFOLD_CA",
        "WAYFOLD_CERT",
        "WAYFOLD_KEY",
        "WAYFOLD_TOKEN",
        "WAYFOLD_TOKEN_FILE",
    ] {
        list.env(name, "");
    }
    let output = list.output().unwrap();
    assert!(output.status.success(), "{output:?}");
}

/// An error names only options that the caller typed.
#[test]
fn an_error_names_the_variable_that_gave_the_value() {
    let error = |args: &[&str], variables: &[(&str, &str)]| {
        let mut command = command("http://127.0.0.1:0", args);
        let output = command.envs(variables.iter().copied()).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    let ca = ("WAYFOLD_CA", "/no/such.pem");
    let token = ("WAYFOLD_TOKEN", "wayfold_of_a_test");
    let usage = error(&["create", "arm", "--token", "x"], &[ca, token]);
    assert!(
        usage.contains("Usage: wayfold create --space <SPACE> --token <TOKEN> <NAME>\n"),
        "{usage}"
    );

    let help = error(&[], &[ca]);
    assert!(
        help.contains("Usage: wayfold [OPTIONS] <COMMAND>\n"),
        "{help}"
    );

    for (variable, option) in [
        ("WAYFOLD_CA", "--ca"),
        ("WAYFOLD_TOKEN_FILE", "--token-file"),
        ("WAYFOLD_CERT", "--cert"),
        ("WAYFOLD_KEY", "--key"),
    ] {
        let named = error(&["list"], &[(variable, "/no/such")]);
        assert!(named.starts_with(&format!("error: {variable}")), "{named}");
        // The option counts before the variable, on either side of the verb.
        for args in [["list", option, "/no/other"], [option, "/no/other", "list"]] {
            let named = error(&args, &[(variable, "/no/such")]);
            assert!(named.starts_with(&format!("error: {option}")), "{named}");
        }
    }
    let both = error(
        &["list", "--key", "/no/key.pem"],
        &[("WAYFOLD_CERT", "/no/cert.pem")],
    );
    assert!(
        both.starts_with("error: WAYFOLD_CERT and --key: "),
        "{both}"
    );
}
