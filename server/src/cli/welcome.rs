//! The welcome on standard output: the addresses first, for programs, then the next commands, for people.

use std::{
    env,
    io::{self, Write},
    net::SocketAddr,
    path::Path,
};

use crate::faces::Addresses;

/// The port that the client connects to by default.
const DEFAULT_PORT: u16 = 50051;

/// Runs the client from the source tree.
const CARGO_CLIENT: &str = "cargo run --release -p wayfold-cli --";

/// Runs the planner of a maze from the source tree.
const CARGO_MAZE: &str = "cargo run --release -p wayfold-examples --bin maze -- --workers 2";

/// Prints the welcome to standard output.
pub(super) fn print(addresses: &Addresses, directory: Option<&Path>) {
    // Under `cargo run` the `wayfold` binary is probably not on the path.
    let client = match env::var_os("CARGO_MANIFEST_DIR") {
        Some(_) => CARGO_CLIENT,
        None => "wayfold",
    };
    let mut out = io::stdout().lock();
    // The server keeps running without a reader of its output.
    let _ = out.write_all(text(addresses, directory, client).as_bytes());
    let _ = out.flush();
}

fn text(addresses: &Addresses, directory: Option<&Path>, client: &str) -> String {
    let address = addresses.grpc;
    let zenoh = addresses.zenoh.iter();
    let zenoh: String = zenoh
        .map(|locator| format!("listening on {locator}\n"))
        .collect();
    let (mut metrics, mut page) = (String::new(), String::new());
    if let Some(at) = addresses.pages {
        let scheme = match addresses.has_tls && !at.ip().is_loopback() {
            true => "https",
            false => "http",
        };
        metrics = format!("metrics at {scheme}://{at}/metrics\n");
        let at = reachable(at);
        page = format!("The indices as they grow, in a browser: {scheme}://{at}/\n");
        // The planner has no options for credentials.
        if !addresses.has_tls && !addresses.has_identities {
            let grpc = reachable(address);
            page += &format!(
                "A planner whose two trees grow there: {CARGO_MAZE} --server http://{grpc} --keep\n"
            );
        }
    }
    let warnings = addresses.warnings.iter();
    let warnings: String = warnings.map(|warning| format!("{warning}\n")).collect();
    let storage = match directory {
        Some(directory) => format!("Indices are kept in {}.", directory.display()),
        None => {
            "Indices are kept in memory and are lost when the server stops (Ctrl-C).".to_owned()
        }
    };
    let scheme = match addresses.has_tls {
        true => "https",
        false => "http",
    };
    let mut client = client.to_owned();
    if addresses.has_tls || address.port() != DEFAULT_PORT {
        client += &format!(" --server {scheme}://{}", reachable(address));
    }
    if addresses.has_tls {
        client += " --ca CA.pem";
    }
    if addresses.has_identities {
        client += " --token-file TOKEN";
    }
    format!(
        "listening on {scheme}://{address}\n\
         {zenoh}{metrics}{warnings}\
         \n\
         {storage} Next, in another terminal:\n\
         \x20 {client} create arm --space 'R3*SO3:0.15'\n\
         \x20 echo '0.1,0.2,0.3,0,0,0,1' | {client} insert arm -\n\
         \x20 {client} knn arm --state 0,0,0,0,0,0,1 -k 1\n\
         \x20 {client} --help\n\
         {page}\
         A state of R3*SO3 is a row of x, y, z and a unit quaternion x, y, z, w. Settings: wayfold-server --help\n"
    )
}

/// The address for a client on this machine.
fn reachable(mut address: SocketAddr) -> SocketAddr {
    if address.ip().is_unspecified() {
        address.set_ip(match address {
            SocketAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
            SocketAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
        });
    }
    address
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(grpc: &str, zenoh: &[&str]) -> Addresses {
        Addresses {
            grpc: grpc.parse().unwrap(),
            pages: None,
            members: None,
            has_tls: false,
            has_identities: false,
            zenoh: zenoh.iter().map(ToString::to_string).collect(),
            warnings: Vec::new(),
        }
    }

    #[test]
    fn cargo_runs_the_package_of_the_client() {
        let manifest = concat!(env!("CARGO_MANIFEST_DIR"), "/../client/cli/Cargo.toml");
        let manifest = std::fs::read_to_string(manifest).unwrap();
        let (_, package) = CARGO_CLIENT.split_once("-p ").unwrap();
        let package = package.trim_end_matches(" --");
        assert!(manifest.contains(&format!("\nname = \"{package}\"\n")));
        assert!(manifest.contains("\n[[bin]]\nname = \"wayfold\"\n"));
    }

    #[test]
    fn the_first_lines_are_the_addresses_alone() {
        let addresses = at("127.0.0.1:50051", &["tcp/127.0.0.1:7448"]);
        let text = text(&addresses, None, "wayfold");
        let lines: Vec<&str> = text.lines().take(2).collect();
        assert_eq!(
            lines,
            [
                "listening on http://127.0.0.1:50051",
                "listening on tcp/127.0.0.1:7448"
            ]
        );
        assert!(text.contains("\n  wayfold create arm "));
    }

    #[test]
    fn the_page_is_named_by_an_address_of_this_machine() {
        let addresses = Addresses {
            pages: Some("0.0.0.0:8080".parse().unwrap()),
            ..at("127.0.0.1:50051", &[])
        };
        let text = text(&addresses, None, "wayfold");
        assert!(text.contains("\nmetrics at http://0.0.0.0:8080/metrics\n"));
        assert!(text.contains(" in a browser: http://127.0.0.1:8080/\n"));
        let page = include_str!("../../../docs/page.md");
        let maze = format!("{CARGO_MAZE} --server http://127.0.0.1:50051 --keep");
        assert!(text.contains(&format!(": {maze}\n")) && page.contains(&maze));
    }

    #[test]
    fn commands_reach_a_server_that_is_not_at_the_default_port() {
        let directory = Some(Path::new("data"));
        let text = text(&at("0.0.0.0:4000", &[]), directory, "wayfold");
        assert!(text.contains("\nIndices are kept in data. Next"));
        assert!(text.starts_with("listening on http://0.0.0.0:4000\n"));
        assert!(text.contains("  wayfold --server http://127.0.0.1:4000 create arm "));
    }

    #[test]
    fn commands_have_the_credentials_that_the_server_asks_for() {
        let addresses = Addresses {
            has_tls: true,
            has_identities: true,
            ..at("127.0.0.1:50051", &[])
        };
        let text = text(&addresses, None, "wayfold");
        assert!(text.starts_with("listening on https://127.0.0.1:50051\n"));
        let command =
            "  wayfold --server https://127.0.0.1:50051 --ca CA.pem --token-file TOKEN create";
        assert!(text.contains(command), "{text}");
    }
}
