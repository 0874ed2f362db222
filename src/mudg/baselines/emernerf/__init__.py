"""EmerNeRF, a radiance field of a street that is marched along rays."""
