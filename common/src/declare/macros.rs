//! The macro that declares a section.

/// Declares a struct and the fields of a section at once. The doc comments are the help of the fields; the one of the
/// struct says what the section is about.
///
/// ```
/// use reveille_common::declare::{POSITIVE, number};
///
/// reveille_common::declare! {
///     /// The rectangle that is served.
///     #[derive(Clone, Copy, Debug)]
///     pub struct Plot in "plot" {
///         /// East-west side.
///         pub width: f64 = number(POSITIVE, 20.0).unit("metres").source("Table II"),
///         /// North-south side.
///         pub height: f64 = number(POSITIVE, 20.0).unit("metres").derived("that of `width`") => width,
///     }
/// }
/// assert_eq!(Plot::SECTION.field("width").map(|field| field.help), Some("East-west side."));
/// ```
///
/// A default that follows from others is an expression over the fields before it, after `=>`; it may use `?`. It gets
/// `SECTION`, `read`, which gives the values of a [`Reader`](super::Reader), each within its range, and `visit`, which
/// hands them to a [`Sink`](super::Sink).
#[macro_export]
macro_rules! declare {
    (
        $(#[doc = $about:literal])+
        #[derive($($derive:path),+ $(,)?)]
        $(#[serde($($serde:tt)*)])*
        $vis:vis struct $type:ident in $path:literal $(only with $condition:literal = $values:expr;)? {
            $(
                $(#[doc = $help:literal])+
                $field_vis:vis $name:ident: $of:ty = $field:expr $(=> $derived:expr)?
            ),+ $(,)?
        }
    ) => {
        $(#[doc = $about])+
        #[derive($($derive),+)]
        $(#[serde($($serde)*)])*
        $vis struct $type {
            $( $(#[doc = $help])+ $field_vis $name: $of ),+
        }

        impl $type {
            /// Its fields as they are declared.
            pub const SECTION: &'static $crate::declare::Section = &$crate::declare::Section {
                path: $path,
                about: concat!($($about),+).trim_ascii(),
                fields: &[$( $field.named(stringify!($name), concat!($($help),+).trim_ascii()) ),+],
                only_with: $crate::declare!(@condition $($condition = $values)?),
            };

            /// The values that `reader` has for the fields.
            ///
            /// # Errors
            /// A value is out of its range, or one that is needed is not set.
            pub fn read(reader: &$crate::declare::Reader<'_>) -> Result<Self, $crate::declare::ScenarioError> {
                let section = Self::SECTION;
                let mut fields = section.fields.iter();
                $(
                    let field = fields.next().expect("one for each");
                    let $name: $of = $crate::declare!(@read reader, section, field, $of $(, $derived)?);
                )+
                Ok(Self { $($name),+ })
            }

            /// Hands every field to `sink`.
            pub fn visit(&self, sink: &mut dyn $crate::declare::Sink) {
                let section = Self::SECTION;
                let values = [$( $crate::declare::Declared::value(&self.$name) ),+];
                for (field, value) in section.fields.iter().zip(values) {
                    if let Some(value) = value {
                        sink.field(section, field, value);
                    }
                }
            }
        }
    };
    (@condition) => { None };
    (@condition $field:literal = $values:expr) => {
        Some($crate::declare::Condition { field: $field, values: $values })
    };
    (@read $reader:ident, $section:ident, $field:ident, $of:ty) => {
        $reader.field::<$of>($section, $field)?
    };
    (@read $reader:ident, $section:ident, $field:ident, $of:ty, $derived:expr) => {
        match $reader.given::<$of>($section, $field)? {
            Some(value) => value,
            None => $derived,
        }
    };
}
