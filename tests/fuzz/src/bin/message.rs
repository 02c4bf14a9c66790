//! Any postcard that is a message: its frame is received as the same message, to the bit.
#![no_main]

use firmware_core::link::Message;
use fuzz::link;
use libfuzzer_sys::fuzz_target;

fuzz_target!(
    init: fuzz::seeds(link::messages().iter().map(link::bytes)),
    |bytes: &[u8]| {
        let Ok((message, _)) = postcard::take_from_bytes::<Message>(bytes) else {
            return;
        };
        link::frame(&message);
        // A command goes to the robot that has as many inputs, and to no other one.
        let inputs = match &message {
            Message::Inputs(inputs) => inputs.len(),
            Message::Frame(_) | Message::Request(_) | Message::Answer(_) => usize::MAX,
            _ => 2,
        };
        assert_eq!(message.command::<2>().is_some(), inputs == 2, "{message:?}");
        if let Some(command) = message.command::<2>() {
            assert_eq!(link::bytes(&command.into()), link::bytes(&message), "{message:?}");
        }
    }
);
