//! Pages of a server for operators, over plain HTTP.

use std::{
    io::{Read, Write},
    net::TcpStream,
};

/// The status and the body of a page at `address`. `header` has further lines of the request, each ended.
///
/// # Panics
/// If there is no whole answer.
pub fn page(address: &str, path: &str, header: &str) -> (u16, String) {
    let mut socket = TcpStream::connect(address).expect("a server");
    let request = format!("GET {path} HTTP/1.1\r\nHost: here\r\n{header}Connection: close\r\n\r\n");
    socket.write_all(request.as_bytes()).expect("a request");
    let mut answer = String::new();
    socket.read_to_string(&mut answer).expect("an answer");
    let (head, body) = answer.split_once("\r\n\r\n").expect("a head");
    let status = head.split(' ').nth(1).expect("a status");
    (status.parse().expect("a number"), body.to_owned())
}
