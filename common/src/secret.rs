//! Secrets that authorise a peer, and the credentials of hosts. Their texts are parts of
//! [key expressions](crate::keys) on the bus, and a secret's text is also the content of a key file
//! (`deploy/src/key.rs`): a change of a text breaks both. A change of a type raises `WIRE_VERSION`.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use subtle::ConstantTimeEq;

use crate::ids::HostId;

/// A random number of 128 bits that cannot be guessed; 32 hexadecimal digits as text. `Display` writes it
/// in lower case; `Debug` does not reveal it.
#[derive(Clone, Copy, Serialize, Deserialize)]
pub struct Secret([u8; 16]);

/// A text that is not a valid secret.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("not 32 hexadecimal digits")]
pub struct SecretError;

impl Secret {
    /// Creates a secret from 16 random bytes.
    pub const fn new(random: [u8; 16]) -> Self {
        Self(random)
    }
}

/// Compares in a time that does not depend on the position of the first difference.
impl PartialEq for Secret {
    fn eq(&self, other: &Self) -> bool {
        self.0.ct_eq(&other.0).into()
    }
}

impl Eq for Secret {}

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
        // `from_str_radix` would accept a sign, and slicing would panic inside a wide character.
        if text.len() != 32 || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(SecretError);
        }
        let mut bytes = [0; 16];
        for (byte, start) in bytes.iter_mut().zip((0..32).step_by(2)) {
            *byte = u8::from_str_radix(&text[start..start + 2], 16).map_err(|_| SecretError)?;
        }
        Ok(Self(bytes))
    }
}

/// A host's credential at the BS: the number from its assignment, and a token that only this host and the BS know. Its
/// text, `HOST/TOKEN`, is the end of the key expressions of the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostCredential {
    /// The host.
    pub host: HostId,
    /// Its token.
    pub token: Secret,
}

impl HostCredential {
    /// Parses the credential at the end of a key expression; `None` without a credential.
    pub fn from_key_expr(key_expr: &str) -> Option<Self> {
        let mut parts = key_expr.rsplit('/');
        let token = parts.next()?.parse().ok()?;
        let host = parts.next()?.parse().ok().map(HostId)?;
        Some(Self { host, token })
    }
}

impl fmt::Display for HostCredential {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.host, self.token)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_round_trips_as_text_and_debug_output_hides_it() {
        let secret = Secret::new(std::array::from_fn(|i| (i * 17) as u8));
        let text = secret.to_string();
        assert_eq!(text, "00112233445566778899aabbccddeeff");
        assert_eq!(text.parse(), Ok(secret));
        for byte in 0..16 {
            let mut other = secret;
            other.0[byte] ^= 1;
            assert_ne!(other, secret, "byte {byte}");
        }
        for invalid in [
            "",
            "00",
            &text[1..],
            &format!("{text}0"),
            "0011223344556677889 aabbccddeef",
            "+011223344556677889aabbccddeeff",
        ] {
            assert_eq!(invalid.parse::<Secret>(), Err(SecretError), "{invalid}");
        }
        assert!(!format!("{secret:?}").contains("11"));
    }

    #[test]
    fn a_credential_is_read_from_the_end_of_a_key_expression() {
        let (host, token) = (HostId(17), Secret::new([0xA5; 16]));
        let credential = HostCredential { host, token };
        let key_expr = format!("reveille/run/3/report/{credential}");
        assert_eq!(HostCredential::from_key_expr(&key_expr), Some(credential));
        for invalid in [
            "reveille/run/report",
            &key_expr[..key_expr.len() - 1],
            &token.to_string(),
        ] {
            assert_eq!(HostCredential::from_key_expr(invalid), None, "{invalid}");
        }
    }
}
