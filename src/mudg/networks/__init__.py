"""Networks that several rooms use: features of images, the codec, attention towers."""
