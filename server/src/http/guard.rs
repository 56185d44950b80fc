//! Keeps pages of other origins away from the data: a browser would carry their requests to this listener.

use std::net::IpAddr;

use axum::{
    extract::{Request, State},
    http::{HeaderMap, StatusCode, header},
    middleware::Next,
    response::{IntoResponse, Response},
};

const REFUSED: &str = "the request may come from another site, or its host may be one: open the page by its address, as localhost, or over TLS\n";

/// How the listener is reached.
#[derive(Clone, Copy, Debug)]
pub(super) struct Guard {
    /// With TLS the certificate shows that the name is the server's.
    pub(super) has_tls: bool,
}

/// Answers requests of the server's own page and of programs. A page of another origin shows itself by `Sec-Fetch-Site`, in
/// older browsers by `Origin`; one whose name was pointed at this machine (DNS rebinding), by a `Host` that is neither an address nor localhost.
pub(super) async fn own_origin(
    State(guard): State<Guard>,
    request: Request,
    next: Next,
) -> Response {
    // HTTP/2 has the host in the address.
    let authority = request.uri().authority().map(|it| it.as_str());
    match guard.admits(request.headers(), authority) {
        true => next.run(request).await,
        false => (StatusCode::FORBIDDEN, REFUSED).into_response(),
    }
}

impl Guard {
    fn admits(self, headers: &HeaderMap, authority: Option<&str>) -> bool {
        let site = headers.get("sec-fetch-site").map(|site| site.as_bytes());
        if !matches!(site, None | Some(b"same-origin" | b"none")) {
            return false;
        }
        let text = |name| headers.get(name).and_then(|it| it.to_str().ok());
        let host = text(header::HOST).or(authority);
        let origin = text(header::ORIGIN).map(|it| it.rsplit('/').next().unwrap_or_default());
        if origin.is_some_and(|origin| host != Some(origin)) {
            return false;
        }
        self.has_tls || host.is_some_and(is_this_machine)
    }
}

/// True for an address or localhost, with a port or without.
fn is_this_machine(host: &str) -> bool {
    let (name, port) = match host.strip_prefix('[') {
        Some(rest) => rest.split_once(']').unwrap_or_default(),
        None => host.split_at(host.find(':').unwrap_or(host.len())),
    };
    let digits = port.strip_prefix(':').unwrap_or(port);
    let is_port = digits.bytes().all(|byte| byte.is_ascii_digit()) && port.len() != digits.len();
    (port.is_empty() || is_port)
        && (name.eq_ignore_ascii_case("localhost") || name.parse::<IpAddr>().is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn admits(has_tls: bool, host: &str, site: Option<&str>) -> bool {
        let mut headers = HeaderMap::new();
        headers.insert(header::HOST, host.parse().unwrap());
        if let Some(site) = site {
            headers.insert("sec-fetch-site", site.parse().unwrap());
        }
        Guard { has_tls }.admits(&headers, None)
    }

    #[test]
    fn a_page_of_another_origin_is_refused() {
        for host in [
            "127.0.0.1:8080",
            "localhost:8080",
            "LOCALHOST",
            "[::1]:8080",
            "10.1.2.3",
        ] {
            assert!(admits(false, host, None), "{host}");
            assert!(admits(false, host, Some("same-origin")), "{host}");
            assert!(!admits(false, host, Some("cross-site")), "{host}");
            assert!(!admits(true, host, Some("same-site")), "{host}");
        }
        for host in [
            "evil.example:8080",
            "localhost.evil.example",
            "127.0.0.1.evil.example",
            "127.0.0.1:1.evil.example",
            "[::1].evil.example",
            "[::1]evil.example:80",
            "[::1",
            "",
        ] {
            assert!(!admits(false, host, None), "{host}");
        }
        assert!(admits(true, "robot.example:8080", None));
        let mut headers = HeaderMap::new();
        headers.insert(header::HOST, "127.0.0.1:8080".parse().unwrap());
        headers.insert(header::ORIGIN, "http://127.0.0.1:8080".parse().unwrap());
        let guard = Guard { has_tls: false };
        assert!(guard.admits(&headers, None));
        for other in ["http://127.0.0.1:9090", "https://evil.example", "null"] {
            headers.insert(header::ORIGIN, other.parse().unwrap());
            assert!(!guard.admits(&headers, None), "{other}");
        }
        headers.remove(header::HOST);
        headers.insert(header::ORIGIN, "https://robot:8080".parse().unwrap());
        let guard = Guard { has_tls: true };
        assert!(guard.admits(&headers, Some("robot:8080")));
        assert!(!guard.admits(&headers, Some("other:8080")));
        assert!(!Guard { has_tls: false }.admits(&HeaderMap::new(), None));
    }
}
