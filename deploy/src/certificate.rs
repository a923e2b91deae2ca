//! The content of a certificate file, for `--tls` and `reveille tls`.

use std::fs;
use std::net::IpAddr;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, anyhow, ensure};
use x509_parser::certificate::{Validity, X509Certificate};
use x509_parser::extensions::GeneralName;
use x509_parser::pem::parse_x509_pem;
use x509_parser::time::ASN1Time;

use crate::display::count_noun;

/// Remaining validity below which commands warn.
const EXPIRY_WARNING: Duration = Duration::from_hours(14 * 24);

/// The fields of a certificate.
pub(crate) struct Certificate {
    /// The common name: the role, or the name of the CA.
    pub name: String,
    /// Host names and addresses that the certificate is valid for.
    pub host_names: Vec<String>,
    /// The common name of the issuer.
    pub issuer: String,
    /// The serial number, hexadecimal.
    pub serial: String,
    /// Validity.
    pub validity: Validity,
}

impl Certificate {
    /// Reads the first certificate in the PEM file `path`.
    ///
    /// # Errors
    /// If it cannot be read.
    pub(crate) fn read(path: &Path) -> anyhow::Result<Self> {
        let place = || path.display().to_string();
        let bytes = fs::read(path).with_context(place)?;
        let invalid = |cause: String| anyhow!("{}: not a certificate: {cause}; run `reveille tls init` again", place());
        let (_, pem) = parse_x509_pem(&bytes).map_err(|error| invalid(error.to_string()))?;
        let certificate = pem.parse_x509().map_err(|error| invalid(error.to_string()))?;
        Ok(Self {
            name: common_name(certificate.subject()),
            host_names: host_names(&certificate),
            issuer: common_name(certificate.issuer()),
            serial: certificate.raw_serial_as_string(),
            validity: certificate.validity().clone(),
        })
    }

    /// Checks that the certificate in `path` is valid now, and warns if it expires soon.
    ///
    /// # Errors
    /// If it has expired, or is not valid yet.
    pub(crate) fn check_validity(&self, path: &Path) -> anyhow::Result<()> {
        let (place, now) = (path.display(), ASN1Time::now());
        let Validity { not_before, not_after } = self.validity;
        ensure!(
            now <= not_after,
            "{place}: expired on {not_after}; renew it with `reveille tls init FOLDER --renew` where the key of the CA \
             is, or make a new CA in another folder if the CA has expired"
        );
        ensure!(
            now >= not_before,
            "{place}: not valid before {not_before}; check the clock of this machine"
        );
        if let Some(left) = not_after - now
            && left.unsigned_abs() < EXPIRY_WARNING
        {
            let days = left.whole_days().unsigned_abs();
            tracing::warn!(
                "{place}: expires in {}; renew it with `reveille tls init FOLDER --renew` where the key of the CA is",
                count_noun(days, "day")
            );
        }
        Ok(())
    }
}

fn common_name(name: &x509_parser::x509::X509Name<'_>) -> String {
    let first = name.iter_common_name().next().and_then(|cn| cn.as_str().ok());
    first.unwrap_or_default().to_owned()
}

fn host_names(certificate: &X509Certificate<'_>) -> Vec<String> {
    let extension = certificate.subject_alternative_name().ok().flatten();
    let names = extension
        .into_iter()
        .flat_map(|extension| &extension.value.general_names);
    names
        .filter_map(|name| {
            if let GeneralName::DNSName(name) = name {
                return Some((*name).to_owned());
            }
            let GeneralName::IPAddress(bytes) = name else {
                return None;
            };
            let v4 = <[u8; 4]>::try_from(*bytes).map(IpAddr::from);
            let address = v4.or_else(|_| <[u8; 16]>::try_from(*bytes).map(IpAddr::from));
            address.ok().map(|address| address.to_string())
        })
        .collect()
}
