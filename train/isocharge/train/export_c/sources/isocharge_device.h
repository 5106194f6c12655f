/* The board $board: its numbers for the signal chain, from its device file. Written by isocharge train export-c. */
#ifndef ISOCHARGE_DEVICE_H
#define ISOCHARGE_DEVICE_H

$lines

#endif
