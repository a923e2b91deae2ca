//! Numbers that open doors: who can say one has been told it.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::ids::HostId;

/// A random number of 128 bits that nobody can guess; 32 hexadecimal digits as text. What is printed for debugging
/// does not give it away.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Secret([u8; 16]);

/// A text that is no secret.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("not 32 hexadecimal digits")]
pub struct SecretError;

impl Secret {
    /// The secret of 16 random bytes.
    pub const fn new(random: [u8; 16]) -> Self {
        Self(random)
    }
}

impl fmt::Display for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(…)")
    }
}

impl FromStr for Secret {
    type Err = SecretError;

    fn from_str(text: &str) -> Result<Self, SecretError> {
        if text.len() != 32 || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(SecretError);
        }
        let mut bytes = [0; 16];
        for (byte, at) in bytes.iter_mut().zip((0..32).step_by(2)) {
            *byte = u8::from_str_radix(&text[at..at + 2], 16).map_err(|_| SecretError)?;
        }
        Ok(Self(bytes))
    }
}

/// By what the BS knows a host: the number that it got with its places, and a token that nobody else was told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostPass {
    /// The host.
    pub host: HostId,
    /// Its token.
    pub token: Secret,
}

impl HostPass {
    /// The pass at the end of `key`, where a host's own keys have it.
    pub fn at_end_of(key: &str) -> Option<Self> {
        let mut parts = key.rsplit('/');
        let token = parts.next()?.parse().ok()?;
        let host = parts.next()?.parse().ok().map(HostId)?;
        Some(Self { host, token })
    }
}

impl fmt::Display for HostPass {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.host, self.token)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_is_read_as_it_is_written_and_not_given_away() {
        let secret = Secret::new(std::array::from_fn(|i| (i * 17) as u8));
        let text = secret.to_string();
        assert_eq!(text, "00112233445566778899aabbccddeeff");
        assert_eq!(text.parse(), Ok(secret));
        for bad in [
            "",
            "00",
            &text[1..],
            &format!("{text}0"),
            "0011223344556677889 aabbccddeef",
            "+011223344556677889aabbccddeeff",
        ] {
            assert_eq!(bad.parse::<Secret>(), Err(SecretError), "{bad}");
        }
        assert!(!format!("{secret:?}").contains("11"));
    }
}
