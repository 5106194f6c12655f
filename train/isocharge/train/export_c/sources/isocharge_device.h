/* The numbers of the signal chain, $origin. Written by isocharge train export-c. */
#ifndef ISOCHARGE_DEVICE_H
#define ISOCHARGE_DEVICE_H

$lines

#endif
