//! Any bytes on the line, and any bytes in a frame whose checksum holds.
#![no_main]

use crc::{CRC_32_ISO_HDLC, Crc};
use firmware_core::control_loop::Command;
use firmware_core::link::{MAX_FRAME, Message, Port, Received};
use firmware_core::update::NoUpdates;
use fuzz::link;
use fuzz::robot::Robot;
use libfuzzer_sys::fuzz_target;

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

fuzz_target!(
    init: {
        // As a stream, and each payload to be framed here.
        let stream = link::messages().iter().flat_map(link::frame).collect();
        fuzz::seeds(link::messages().iter().map(link::bytes).chain([stream]))
    },
    |bytes: &[u8]| {
        on_the_line(bytes);
        in_a_frame(bytes);
    }
);

/// Whatever comes, messages are messages, and the next whole frame after a zero is received.
fn on_the_line(bytes: &[u8]) {
    let received = link::receive(bytes);
    for (message, piece) in received.iter().zip(pieces(bytes)) {
        if let Received::Message(message) = message {
            assert!(piece.len() < MAX_FRAME, "{} bytes and a zero", piece.len());
            // The one way to write it, which may be shorter than what came.
            assert!(link::frame(message).len() <= piece.len() + 1, "{piece:02x?}");
        }
    }
    for message in link::messages() {
        let after = [bytes, &[0], &link::frame(&message)].concat();
        let Some(Received::Message(last)) = link::receive(&after).pop() else {
            panic!("{message:?} was not received")
        };
        assert_eq!(link::bytes(&last), link::bytes(&message));
    }
    port(bytes, &received);
}

/// What lies between the zeros, each but the empty ones completed by its zero.
fn pieces(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    bytes.split(|byte| *byte == 0).filter(|piece| !piece.is_empty())
}

/// The controller's end takes the same commands, and counts what is none and no request.
fn port(mut bytes: &[u8], received: &[Received]) {
    let (mut port, mut robot) = (Port::new(), Robot::default());
    while !bytes.is_empty() {
        let before = bytes.len();
        port.receive(&mut bytes, &mut robot, &mut NoUpdates, 0);
        assert!(bytes.len() < before, "the port does not read");
    }
    let expected: Vec<Command<2>> = received
        .iter()
        .filter_map(|received| match received {
            Received::Message(message) => message.command(),
            _ => None,
        })
        .collect();
    let is_request = |r: &&Received| matches!(r, Received::Message(Message::Request(_)));
    let requests = received.iter().filter(is_request).count();
    assert_eq!(port.damaged() as usize, received.len() - expected.len() - requests);
    let bits = |command: &Command<2>| link::bytes(&(*command).into());
    let commands: Vec<_> = robot.commands.iter().map(bits).collect();
    assert_eq!(commands, expected.iter().map(bits).collect::<Vec<_>>());
}

/// Bytes whose checksum is right are a message exactly if postcard reads them, to the last one.
fn in_a_frame(payload: &[u8]) {
    let plain = [payload, &CRC.checksum(payload).to_le_bytes()].concat();
    let frame = stuffed(&plain);
    let received = link::receive(&frame);
    let [received] = &received[..] else { panic!("{received:?}") };
    let message = match postcard::take_from_bytes::<Message>(payload) {
        Ok((message, [])) => Some(message),
        _ => None,
    };
    match (received, message) {
        (Received::Message(received), Some(message)) => {
            assert_eq!(link::bytes(received), link::bytes(&message));
            assert!(link::frame(received).len() <= frame.len());
        }
        (Received::Unknown { variant, .. }, None) => {
            assert_eq!(*variant, payload.first().copied().unwrap_or(0));
        }
        (Received::TooLong, _) => assert!(frame.len() > MAX_FRAME),
        (received, message) => panic!("{received:?} of {message:?} in {} bytes", frame.len()),
    }
}

/// COBS by the paper: a byte that says where the next zero is, in front of every piece; the zero at the end
/// included.
fn stuffed(plain: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    for piece in plain.split(|byte| *byte == 0) {
        let mut blocks = piece.chunks(254).peekable();
        if blocks.peek().is_none() {
            out.push(1);
        }
        while let Some(block) = blocks.next() {
            out.push(block.len() as u8 + 1);
            out.extend_from_slice(block);
            // A full block stands for no zero; a piece that ends with one needs an empty one behind it.
            if block.len() == 254 && blocks.peek().is_none() {
                out.push(1);
            }
        }
    }
    out.push(0);
    out
}
