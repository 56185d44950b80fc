//! A client that reads no answers of a stream, and makes HTTP/2 hold more than it sends on that.

use std::{
    io::{self, Read, Write},
    net::TcpStream,
};

use bytes::{BufMut, BytesMut};
use wayfold_tests::server;

use crate::metrics::figures;

const DATA: u8 = 0;
const HEADERS: u8 = 1;
const SETTINGS: u8 = 4;
const WINDOW_UPDATE: u8 = 8;
/// Receivers ignore frames of types that they do not know.
const UNKNOWN: u8 = 200;
const ACK: u8 = 1;
pub(crate) const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;
const STREAM: u32 = 1;
/// The largest frame without a setting.
const MAX_FRAME: usize = 16 * 1024;
const MESSAGE_BYTES: usize = 1024 * 1024;

fn put_frame(sent: &mut BytesMut, kind: u8, flags: u8, stream: u32, payload: &[u8]) {
    sent.put_uint(payload.len() as u64, 3);
    sent.put_slice(&[kind, flags]);
    sent.put_u32(stream);
    sent.put_slice(payload);
}

/// A connection whose client takes this number of bytes of each answer.
pub(crate) fn connection(uri: &str, window: u8) -> TcpStream {
    let mut socket = TcpStream::connect(uri.strip_prefix("http://").unwrap()).unwrap();
    let mut sent = BytesMut::from(&b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"[..]);
    let initial_window_size = [0, 4, 0, 0, 0, window];
    put_frame(&mut sent, SETTINGS, 0, 0, &initial_window_size);
    socket.write_all(&sent).unwrap();
    // The windows of the server apply after its WINDOW_UPDATE and the acknowledgement of its settings.
    while read_frame(&mut socket) != WINDOW_UPDATE {}
    sent.clear();
    put_frame(&mut sent, SETTINGS, ACK, 0, &[]);
    socket.write_all(&sent).unwrap();
    socket
}

/// Reads a frame and returns its kind.
fn read_frame(socket: &mut TcpStream) -> u8 {
    let mut header = [0; 9];
    socket.read_exact(&mut header).unwrap();
    let length = u32::from_be_bytes([0, header[0], header[1], header[2]]);
    socket.read_exact(&mut vec![0; length as usize]).unwrap();
    header[3]
}

/// Begins a call with one message on a stream of a connection. The flags of the message may end the request.
pub(crate) fn begin(
    socket: &mut TcpStream,
    stream: u32,
    path: &str,
    message: &[u8],
    flags: u8,
) -> io::Result<()> {
    let mut framed = BytesMut::from(&[0][..]);
    framed.put_u32(message.len() as u32);
    framed.put_slice(message);
    let mut sent = headers(stream, path);
    put_frame(&mut sent, DATA, flags, stream, &framed);
    socket.write_all(&sent)
}

/// Begins a call on a stream of a connection with the first half of a message of so many bytes.
pub(crate) fn begin_half(
    socket: &mut TcpStream,
    stream: u32,
    path: &str,
    bytes: usize,
) -> io::Result<()> {
    let mut framed = BytesMut::from(&[0][..]);
    framed.put_u32(bytes as u32);
    framed.put_bytes(0, bytes / 2);
    let mut sent = headers(stream, path);
    for part in framed.chunks(MAX_FRAME) {
        put_frame(&mut sent, DATA, 0, stream, part);
    }
    socket.write_all(&sent)
}

/// The frame that begins a call.
fn headers(stream: u32, path: &str) -> BytesMut {
    let mut headers = BytesMut::new();
    for (name, value) in [
        (":method", "POST"),
        (":scheme", "http"),
        (":path", path),
        (":authority", "127.0.0.1"),
        ("content-type", "application/grpc"),
        ("te", "trailers"),
    ] {
        // A literal header that is not indexed (RFC 7541, 6.2.2).
        headers.put_u8(0);
        for text in [name, value] {
            headers.put_u8(text.len() as u8);
            headers.put_slice(text.as_bytes());
        }
    }
    let mut sent = BytesMut::new();
    put_frame(&mut sent, HEADERS, END_HEADERS, stream, &headers);
    sent
}

/// Sends frames of `bytes` between large ones that are ignored, until the connection ends.
fn send_until_cut(uri: &str, bytes: usize) {
    let mut socket = connection(uri, 0);
    // A bad request, whose answer waits.
    begin(
        &mut socket,
        STREAM,
        "/wayfold.v1.PointService/StreamKnn",
        &[],
        0,
    )
    .unwrap();
    let mut part = BytesMut::new();
    put_frame(&mut part, UNKNOWN, 0, 0, &[0; MAX_FRAME]);
    put_frame(&mut part, DATA, 0, STREAM, &vec![0; bytes]);
    let mut sent = 0;
    // HTTP/2 itself takes a thousand frames of a byte, and four thousand of 256.
    while sent < 64 * MESSAGE_BYTES {
        match socket.write_all(&part) {
            Ok(()) => sent += part.len(),
            Err(error) => {
                let kinds = [io::ErrorKind::ConnectionReset, io::ErrorKind::BrokenPipe];
                assert!(kinds.contains(&error.kind()), "{error}");
                return;
            }
        }
    }
    panic!("the server took {sent} bytes");
}

#[test]
fn what_is_sent_on_a_stream_that_is_not_read_counts_with_all_that_it_holds() {
    let mut server = server!(
        "--http", "127.0.0.1:0";
        ("WAYFOLD_GRPC__MAX_MESSAGE_BYTES", &MESSAGE_BYTES.to_string()),
        ("WAYFOLD_ZENOH__MAX_MESSAGE_BYTES", &MESSAGE_BYTES.to_string()),
        ("WAYFOLD_ADMISSION__MAX_BYTES", &(4 * MESSAGE_BYTES).to_string())
    );
    let pages = server.pages();
    let refused = "wayfold_refused_calls_total{reason=\"TOO_MANY_BYTES\"}";
    for (cut, bytes) in [(1.0, 1), (2.0, 256)] {
        send_until_cut(server.uri(), bytes);
        assert_eq!(figures(&pages)[refused], cut);
    }
}
