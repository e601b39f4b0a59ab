// One ad hoc 802.11 network in ns-3.44: who sends what when, and when each receiver has it.
//
// Every node sends frames of `size` bytes, which LLC/SNAP (8), MAC header (24) and FCS (4) make a PSDU of size + 36: periodically
// with a random phase, or as a file says, or (saturated) whenever the last one has been dealt with. Totals go to stdout as JSON,
// frames to --out as int64 rows: sender, seq, to (-1: all), sent_ns, first_start_ns, last_start_ns (-1: never), attempts, and then
// for each of the n nodes received_ns (-1: not). --log writes what happens, event by event, to stderr.
// Everything that is not an option here is ns-3's default; defaults themselves can be set (--ns3::WifiPhy::CcaEdThreshold=-70).

#include "wifi_frames.h"

#include "ns3/mobility-module.h"
#include "ns3/propagation-module.h"

#include <ctime>
#include <map>

namespace
{
std::vector<std::vector<double>> ReadRows(const std::string& path)
{
    std::ifstream file(path);
    NS_ABORT_MSG_IF(!file, "cannot read " << path);
    std::vector<std::vector<double>> rows;
    for (std::string line; std::getline(file, line);)
    {
        std::replace(line.begin(), line.end(), ',', ' ');
        std::istringstream text(line);
        std::vector<double> row;
        for (double value; text >> value;)
        {
            row.push_back(value);
        }
        if (!row.empty()) // not a heading, nor an empty line
        {
            rows.push_back(row);
        }
    }
    return rows;
}

std::string ModeName(std::string rate)
{
    const bool dsss = rate == "1" || rate == "2" || rate == "5.5" || rate == "11";
    std::replace(rate.begin(), rate.end(), '.', '_');
    return (dsss ? "DsssRate" : opt.standard == "a" ? "OfdmRate" : "ErpOfdmRate") + rate + "Mbps";
}

void Build(const std::vector<std::vector<double>>& positions)
{
    NodeContainer nodes;
    nodes.Create(positions.size());
    auto list = CreateObject<ListPositionAllocator>();
    for (const auto& p : positions)
    {
        list->Add(Vector(p.at(0), p.at(1), p.size() > 2 ? p[2] : 0.0));
    }
    MobilityHelper mobility;
    mobility.SetPositionAllocator(list);
    mobility.SetMobilityModel("ns3::ConstantPositionMobilityModel");
    mobility.Install(nodes);

    YansWifiChannelHelper channel;
    if (opt.delay)
    {
        channel.SetPropagationDelay("ns3::ConstantSpeedPropagationDelayModel");
    }
    else
    {
        channel.SetPropagationDelay("ns3::ConstantSpeedPropagationDelayModel", "Speed", DoubleValue(1e15));
    }
    channel.AddPropagationLoss("ns3::LogDistancePropagationLossModel",
                               "Exponent", DoubleValue(opt.exponent),
                               "ReferenceDistance", DoubleValue(opt.referenceDistance),
                               "ReferenceLoss", DoubleValue(opt.referenceLoss));
    if (opt.fading == "nakagami")
    {
        const DoubleValue m(opt.m);
        channel.AddPropagationLoss("ns3::NakagamiPropagationLossModel", "m0", m, "m1", m, "m2", m);
    }
    YansWifiPhyHelper phy;
    phy.SetChannel(channel.Create());
    phy.Set("TxPowerStart", DoubleValue(opt.txPower));
    phy.Set("TxPowerEnd", DoubleValue(opt.txPower));
    const std::map<std::string, std::string> models{{"table", "TableBased"}, {"yans", "Yans"}, {"nist", "Nist"}};
    phy.SetErrorRateModel("ns3::" + models.at(opt.errorModel) + "ErrorRateModel");
    if (opt.detection)
    {
        phy.SetPreambleDetectionModel("ns3::ThresholdPreambleDetectionModel",
                                      "MinimumRssi", DoubleValue(opt.preambleRssi),
                                      "Threshold", DoubleValue(opt.preambleSnr));
    }
    else
    {
        phy.DisablePreambleDetectionModel();
    }
    std::string name = ModeName(opt.rate);
    const std::map<std::string, WifiStandard> standards{
        {"a", WIFI_STANDARD_80211a}, {"b", WIFI_STANDARD_80211b}, {"g", WIFI_STANDARD_80211g}, {"n", WIFI_STANDARD_80211n},
        {"ax", WIFI_STANDARD_80211ax}};
    WifiHelper wifi;
    wifi.SetStandard(standards.at(opt.standard));
    WifiMacHelper mac;
    mac.SetType("ns3::AdhocWifiMac");
    if (opt.standard == "n") // one stream, 20 MHz, 800 ns, no aggregation
    {
        const std::vector<std::string> rates{"6.5", "13", "19.5", "26", "39", "52", "58.5", "65"};
        name = "HtMcs" + std::to_string(std::find(rates.begin(), rates.end(), opt.rate) - rates.begin());
        phy.Set("ChannelSettings", StringValue("{0, 20, BAND_2_4GHZ, 0}"));
        mac.SetType("ns3::AdhocWifiMac", "BE_MaxAmpduSize", UintegerValue(0));
    }
    if (opt.standard == "ax") // as n
    {
        const std::vector<std::string> rates{"8.6", "17.2", "25.8", "34.4", "51.6", "68.8", "77.4", "86", "103.2", "114.7", "129", "143.4"};
        name = "HeMcs" + std::to_string(std::find(rates.begin(), rates.end(), opt.rate) - rates.begin());
        Config::SetDefault("ns3::HeConfiguration::GuardInterval", TimeValue(NanoSeconds(800)));
        phy.Set("ChannelSettings", StringValue("{0, 20, BAND_2_4GHZ, 0}"));
        mac.SetType("ns3::AdhocWifiMac", "BE_MaxAmpduSize", UintegerValue(0));
    }
    const StringValue mode(name);
    const StringValue control(opt.control.empty() ? name : ModeName(opt.control));
    if (opt.ideal)
    {
        wifi.SetRemoteStationManager("ns3::IdealWifiManager");
    }
    else
    {
        wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager", "DataMode", mode, "NonUnicastMode", mode, "ControlMode", control);
    }
    devices = wifi.Install(phy, mac, nodes);
    WifiHelper::AssignStreams(devices, 1000);
}

void StartTraffic(uint32_t n)
{
    if (!opt.arrivals.empty()) // rows: seconds, sender[, to[, size]]
    {
        for (const auto& row : ReadRows(opt.arrivals))
        {
            const uint32_t sender = static_cast<uint32_t>(row.at(1));
            const int to = row.size() > 2 ? static_cast<int>(row[2]) : To(sender);
            const uint32_t size = row.size() > 3 ? static_cast<uint32_t>(row[3]) : opt.size;
            Simulator::Schedule(NanoSeconds(std::llround(row.at(0) * 1e9)), &Send, sender, to, size);
        }
        return;
    }
    auto phase = CreateObject<UniformRandomVariable>();
    phase->SetStream(999);
    const Time period = Seconds(1.0 / opt.hz);
    for (uint32_t i = opt.sink ? 1 : 0; i < n; i++)
    {
        const Time first = opt.saturated ? MicroSeconds(i) : NanoSeconds(std::floor(phase->GetValue(0, 1e9 / opt.hz)));
        if (opt.saturated)
        {
            Simulator::Schedule(first, [i] { for (uint32_t k = 0; k < opt.queued; k++) Send(i, To(i), opt.size); });
        }
        else
        {
            Simulator::Schedule(first, &SendPeriodically, i, period);
        }
    }
}

} // namespace

int main(int argc, char** argv)
{
    CommandLine cmd;
    cmd.AddValue("standard", "b, g, a, or n or ax at 2.4 GHz", opt.standard);
    cmd.AddValue("rate", "Mbit/s: 1, 2, 5.5, 11, 6 .. 54, 6.5 .. 65, 8.6 .. 143.4", opt.rate);
    cmd.AddValue("positions", "file, rows x,y,z in m", opt.positions);
    cmd.AddValue("arrivals", "file, rows seconds,sender[,to[,size]]; to -1: all; instead of --hz", opt.arrivals);
    cmd.AddValue("hz", "frames a second and node", opt.hz);
    cmd.AddValue("size", "payload, bytes", opt.size);
    cmd.AddValue("duration", "s: frames handed over in this time, after the warmup, count", opt.duration);
    cmd.AddValue("warmup", "s before", opt.warmup);
    cmd.AddValue("drain", "s after; traffic goes on", opt.drain);
    cmd.AddValue("seed", "of everything", opt.seed);
    cmd.AddValue("exponent", "of the log-distance path loss", opt.exponent);
    cmd.AddValue("reference-loss", "dB", opt.referenceLoss);
    cmd.AddValue("reference-distance", "m", opt.referenceDistance);
    cmd.AddValue("tx-power", "dBm", opt.txPower);
    cmd.AddValue("error-model", "table, yans or nist", opt.errorModel);
    cmd.AddValue("fading", "none or nakagami", opt.fading);
    cmd.AddValue("m", "of Nakagami", opt.m);
    cmd.AddValue("unicast", "to the next node instead of to all", opt.unicast);
    cmd.AddValue("sink", "all nodes send to node 0", opt.sink);
    cmd.AddValue("ideal", "rate control: IdealWifiManager", opt.ideal);
    cmd.AddValue("control", "Mbit/s: rate of RTS", opt.control);
    cmd.AddValue("saturated", "as many frames as go out, instead of --hz", opt.saturated);
    cmd.AddValue("queued", "with --saturated: frames that wait at each node", opt.queued);
    cmd.AddValue("preamble-rssi", "dBm", opt.preambleRssi);
    cmd.AddValue("preamble-snr", "dB", opt.preambleSnr);
    cmd.AddValue("detection", "preamble detection model: 1 threshold, 0 none", opt.detection);
    cmd.AddValue("propagation-delay", "1 by the speed of light, 0 none", opt.delay);
    cmd.AddValue("out", "file for the frames", opt.out);
    cmd.AddValue("why", "also OUT.why: uint8 frames x nodes, 1 + last reason of a drop (all frames sent, drain included)", opt.why);
    cmd.AddValue("log", "events to stderr", opt.log);
    cmd.Parse(argc, argv);

    RngSeedManager::SetSeed(opt.seed);
    const auto positions = ReadRows(opt.positions);
    Build(positions);
    next.assign(positions.size(), 0);
    for (uint32_t i = 0; i < positions.size(); i++)
    {
        Trace(i);
    }
    StartTraffic(positions.size());
    Simulator::Stop(Seconds(opt.warmup + opt.duration + opt.drain));
    const auto begin = std::clock();
    Simulator::Run();
    const double cpuS = double(std::clock() - begin) / CLOCKS_PER_SEC;
    Report(positions.size(), cpuS);
    Simulator::Destroy();
    return 0;
}
