//! The operations: a file for each, and the list of all.

mod description;

mod batch_norm;
mod broadcast;
mod conv;
mod deconv;
mod deform_conv;
mod depthwise;
mod gate;
mod gather;
mod global_mean;
mod head;
mod int8;
mod max_pool;
mod normalise;
mod product;
mod upsample_add;
mod window_attention;
mod winograd;

pub use description::{Description, Machine, Shader};
pub(crate) use winograd::transformed;

/// Makes the type [`Op`] of a list of descriptions.
macro_rules! operations {
    ($($module:ident::$Name:ident),* $(,)?) => {
        $(pub use $module::$Name;)*

        /// What an operation computes: one of the descriptions.
        #[derive(Clone, Debug, PartialEq, Eq)]
        pub enum Op {
            $(#[doc = concat!("See [`struct@", stringify!($Name), "`].")] $Name($Name),)*
        }

        impl Op {
            /// All that is to be known of it.
            pub fn description(&self) -> &dyn Description {
                match self {
                    $(Op::$Name(description) => description,)*
                }
            }
        }

        $(
            impl From<$Name> for Op {
                fn from(description: $Name) -> Self {
                    Op::$Name(description)
                }
            }
        )*
    };
}

operations! {
    normalise::Normalise,
    conv::Conv,
    winograd::Winograd,
    winograd::WinogradDeconv,
    deform_conv::DeformConv,
    depthwise::Depthwise,
    batch_norm::BatchNorm,
    max_pool::MaxPool,
    upsample_add::UpsampleAdd,
    gather::Gather,
    deconv::Deconv,
    window_attention::WindowAttention,
    gate::Gate,
    global_mean::GlobalMean,
    broadcast::Broadcast,
    head::Head,
    int8::NormaliseI8,
    int8::ConvI8,
    int8::DeformConvI8,
    int8::DepthwiseI8,
    int8::DeconvI8,
    int8::MaxPoolI8,
    int8::UpsampleAddI8,
    int8::GatherI8,
    int8::GateI8,
    int8::GlobalMeanI8,
    int8::BroadcastI8,
    int8::HeadI8,
    int8::Quantise,
    int8::Dequantise,
}
